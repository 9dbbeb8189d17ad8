"""The depth camera: viewpoints, points from depth images, and what a planner receives."""

from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, PositiveFloat

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_sim.engine import SimCamera

CAMERA = SimCamera()
FAR_SHARE = 0.999  # share of the camera's range; at larger depths a pixel is empty
TableView = Literal["known", "seen", "around", "auto"]
Float = TypeVar("Float", bound=np.floating)


@dataclass(frozen=True, slots=True)
class Observation:
    """The point cloud of one or several depth images, and other input of a planner."""

    cloud: Float32  # (N, 3) world frame, metres; in the order of the pixels
    workspace: Float32  # (2, 3) corners of the region for grasps, unless `table` is `auto`
    table_height: float  # metres; not to be used if `table` is `auto`
    camera_positions: Float32  # (V, 3) float32, every camera, world frame, metres
    view_ids: NDArray[np.int32]  # (N,) int32, which camera saw each point
    table: TableView = "known"  # what the cloud contains, see `PlanningRules`
    pixels: Int64 | None = None  # (N,) row-major; None: several images, or a cropped cloud

    @property
    def image(self) -> Float32:
        """The cloud as an image (H, W, 3) with NaN holes, or as points (N, 3)."""
        if self.pixels is None:
            return self.cloud
        image = np.full((CAMERA.height * CAMERA.width, 3), np.nan, dtype=np.float32)
        image[self.pixels] = self.cloud
        return image.reshape(CAMERA.height, CAMERA.width, 3)

    @property
    def camera_position(self) -> Float32:
        """The first camera, world frame, metres: (3,)."""
        return np.asarray(self.camera_positions[0])


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"got {ends}; give the lower end first")
    return ends


# Checked in a protocol's file.
Range = Annotated[tuple[float, float], AfterValidator(_ascending)]
Sizes = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_ascending)]


@dataclass(frozen=True, slots=True)
class ViewRange:
    """Possible camera positions: ranges of spherical coordinates around `target`."""

    radius: Sizes  # metres
    polar_degrees: Range  # from world z
    azimuth_degrees: Range  # from world x
    target: tuple[float, float, float]  # the point looked at, world frame, metres

    def sample(self, rng: np.random.Generator, views: int = 1) -> list[Float64]:
        """Draw a pose `T_world_camera` (4, 4), and others evenly spread over a full turn."""
        radius = rng.uniform(*self.radius)
        polar = rng.uniform(*np.deg2rad(self.polar_degrees))
        first = rng.uniform(*np.deg2rad(self.azimuth_degrees))
        target = np.asarray(self.target)
        poses = []
        for azimuth in first + 2 * np.pi * np.arange(views) / views:
            level = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
            poses.append(look_at(target + radius * np.array([*level, np.cos(polar)]), target))
        return poses


# The views of the reference evaluation.
EVALUATION_VIEWS = ViewRange((0.6, 0.75), (45.0, 60.0), (0.0, 180.0), (0.15, 0.15, 0.25))


def look_at(eye: Float64, target: Float64) -> Float64:
    """Pose T_world_camera (4, 4) at `eye` that looks at `target` with world z up in the image.

    Camera axes: x right, y down, z along the line of sight; if z is vertical, x is world x.
    """
    sight = np.asarray(target, dtype=np.float64) - eye
    right = np.cross(sight, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    z = sight / np.linalg.norm(sight)
    x = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, eye
    return T


def unproject_to_world(depth: Float64, T_world_camera: Float64, camera: SimCamera) -> Float64:
    """The points of a depth image (height, width) nearer than `far`: (N, 3) metres, world frame."""
    seen = depth < FAR_SHARE * camera.far
    # The renderer samples a pixel at its lower left corner.
    right = (np.arange(camera.width) - camera.centre_x) * depth
    down = (np.arange(1, camera.height + 1)[:, None] - camera.centre_y) * depth
    right, down = right[seen] / camera.focal_length, down[seen] / camera.focal_length
    in_camera = np.stack((right, down, depth[seen]))
    return (T_world_camera[:3, :3] @ in_camera + T_world_camera[:3, 3:]).T


def crop(points: NDArray[Float], box: NDArray[np.floating], margin: float = 0.0) -> NDArray[Float]:
    """The points (N, 3) in a box (2, 3), lowest and highest corner, grown by a margin."""
    inside = (points >= box[0] - margin) & (points <= box[1] + margin)
    return np.asarray(points[inside[:, 0] & inside[:, 1] & inside[:, 2]])
