"""The plane that objects rest on: given, or found in the cloud."""

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from edgegrasp_model.option_types import Finite, Strict, UnitVector, numeric

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

SUPPORT_MARGIN = 0.005  # metres above a given plane below which points belong to it
TRIALS = 5000  # planes through three points
JUDGED = 1000  # planes of the right tilt that are judged at most
SAMPLE = 2000  # points that planes are judged by
CROWD_RADIUS = 0.02  # metres around a point in which others share its surface
REFINEMENTS = 3  # least squares over the plane's points


class SupportPlane(Strict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    kind: Literal["plane"] = "plane"
    normal: UnitVector = Field(description="unit normal, away from the table")
    offset: Finite = Field(description="normal . x of its points, metres")
    max_depth_error: Annotated[float, Field(ge=0.0, le=0.3), numeric] = Field(
        default=0.0,
        description="share by which a camera's depths may be wrong: each view is scaled about its "
        "viewpoint by up to this until the plane that it sees lies in place; 0: not at all",
    )

    def heights(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Heights (N,) of points (N, 3) over the plane, metres."""
        heights: NDArray[np.floating] = points @ np.asarray(self.normal) - self.offset
        return heights


class RansacPlane(Strict):
    """Look for the plane in the cloud: the largest of those near the level.

    Found by RANSAC from the request's seed, within the workspace. Its points are removed before
    anything else; the plane stays as an obstacle. None found: a warning, and no support plane.
    """

    kind: Literal["ransac"] = "ransac"
    distance: Annotated[float, Field(gt=0.0, le=0.1), numeric] = Field(
        default=0.005, description="metres from the plane within which points belong to it"
    )
    max_tilt: Annotated[float, Field(ge=0.0, le=1.6), numeric] = Field(
        default=0.35, description="radians between its normal and up; a quarter turn: any plane"
    )
    min_share: Annotated[float, Field(gt=0.0, le=1.0), numeric] = Field(
        default=0.1, description="share of the seen surface it must hold"
    )


def find_support_plane(
    points: Float32, request: RansacPlane, up: ArrayLike, rng: np.random.Generator
) -> SupportPlane | None:
    """Find the largest plane by RANSAC, then fit it to its points by least squares.

    Args:
        points: (N, 3) metres.
        request: How thick, how steep and how large it may be.
        up: (3,) away from gravity, of any length; the normal is on this side.
        rng: Source of the trials.

    Returns:
        The plane; None where none holds enough of the seen surface.
    """
    if len(points) < 3:
        return None
    upward: Float64 = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    judged = points[rng.choice(len(points), min(SAMPLE, len(points)), replace=False)]
    corners = judged[rng.integers(len(judged), size=(TRIALS, 3))].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 1e-12], corners[lengths > 1e-12]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where((normals @ upward < 0)[:, None], -normals, normals)
    level = normals @ upward >= math.cos(min(request.max_tilt, math.pi / 2)) - 1e-9
    normals, corners = normals[level][:JUDGED], corners[level][:JUDGED]
    if len(normals) == 0:
        return None
    offsets = np.einsum("td,td->t", normals, corners[:, 0])
    held = np.abs(judged @ normals.T - offsets) < request.distance  # (S, T)
    # What is near the camera has more points: each counts for the surface it stands for.
    crowd = cKDTree(judged).query_ball_point(judged, CROWD_RADIUS, return_length=True)
    share = (1.0 / crowd) @ held / (1.0 / crowd).sum()  # (T,)
    best = int(share.argmax())
    if share[best] < request.min_share:
        return None
    normal, offset = normals[best], float(offsets[best])
    for _ in range(REFINEMENTS):
        near = np.abs(points @ normal - offset) < request.distance
        if near.sum() < 3:
            return None
        normal, offset = _fitted(points[near], upward)
    if normal @ upward < math.cos(min(request.max_tilt, math.pi / 2)) - 1e-3:
        return None
    return SupportPlane(normal=_vector(normal), offset=offset)


def _fitted(points: Float32, up: Float64) -> tuple[Float64, float]:
    """Normal, on the side of `up`, and offset of the plane nearest to points (N, 3)."""
    middle = points.mean(axis=0, dtype=np.float64)
    around = points - middle
    _, vectors = np.linalg.eigh(around.T @ around)  # ascending
    normal: Float64 = vectors[:, 0] if vectors[:, 0] @ up >= 0 else -vectors[:, 0]
    return normal, float(normal @ middle)


def _vector(array: Float64) -> tuple[float, float, float]:
    x, y, z = array.tolist()
    return x, y, z
