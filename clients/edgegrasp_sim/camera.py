"""The depth camera: intrinsics, viewpoints, rendering, and the way from depth to points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pybullet

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edgegrasp_sim.poses import Matrix
    from edgegrasp_sim.world import World


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera; lengths in pixels, clipping distances in metres."""

    width: int = 640
    height: int = 480
    focal_length: float = 540.0
    centre_x: float = 320.0
    centre_y: float = 240.0
    near: float = 0.1
    far: float = 2.0


@dataclass(frozen=True, slots=True)
class ViewRange:
    """Where a camera may stand: ranges of spherical coordinates around `target`.

    Attributes:
        radius: metres.
        polar_angle: radians from world z.
        azimuth: radians from world x.
        target: the point looked at, world frame, metres.
    """

    radius: tuple[float, float]
    polar_angle: tuple[float, float]
    azimuth: tuple[float, float]
    target: tuple[float, float, float] = (0.15, 0.15, 0.25)

    def sample(self, rng: np.random.Generator) -> Matrix:
        """Draw one pose `T_world_camera`, uniform in each coordinate: (4, 4)."""
        return self.sample_ring(rng, 1)[0]

    def sample_ring(self, rng: np.random.Generator, views: int) -> list[Matrix]:
        """Draw one pose as `sample` does, and others spread evenly over a full turn from it."""
        radius = rng.uniform(*self.radius)
        polar = rng.uniform(*self.polar_angle)
        first = rng.uniform(*self.azimuth)
        target = np.asarray(self.target)
        poses = []
        for azimuth in first + 2 * np.pi * np.arange(views) / views:
            direction = np.array(
                [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
            )
            poses.append(look_at(target + radius * direction, target))
        return poses


# The views of the reference evaluation, and the wider ones to draw training views from.
EVALUATION_VIEWS = ViewRange((0.6, 0.75), (np.pi / 4, np.pi / 3), (0.0, np.pi))
TRAINING_VIEWS = ViewRange((0.45, 0.75), (np.pi / 6, np.pi * 5 / 12), (0.0, 2 * np.pi))


def look_at(eye: Matrix, target: Matrix) -> Matrix:
    """Pose of a camera at `eye` that looks at `target` with world z up in the image.

    Camera axes: x to the right of the image, y down, z along the line of sight.

    Returns:
        `T_world_camera`, (4, 4).

    Raises:
        ValueError: the line of sight is vertical, or eye and target coincide.
    """
    sight = np.asarray(target, dtype=np.float64) - eye
    right = np.cross(sight, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"cannot look from {eye} at {target}: choose a slanted line of sight")
    z = sight / np.linalg.norm(sight)
    x = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, eye
    return T


class Camera:
    """A depth camera in a world."""

    def __init__(self, world: World, intrinsics: Intrinsics | None = None) -> None:
        self.world = world
        self.intrinsics = intrinsics if intrinsics is not None else Intrinsics()

    def render_depth(self, T_world_camera: Matrix) -> NDArray[np.float64]:
        """Distance along the line of sight for every pixel: (height, width) metres.

        Pixels that show nothing read `far`.
        """
        k = self.intrinsics
        view = np.linalg.inv(T_world_camera)
        view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
        _, _, _, z_buffer, _ = pybullet.getCameraImage(
            k.width,
            k.height,
            viewMatrix=view.flatten(order="F").tolist(),
            projectionMatrix=_projection(k).flatten(order="F").tolist(),
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.world.client,
        )
        z = np.asarray(z_buffer, dtype=np.float64).reshape(k.height, k.width)
        return k.far * k.near / (k.far - (k.far - k.near) * z)

    def points(self, depth: NDArray[np.float64], T_world_camera: Matrix) -> NDArray[np.float64]:
        """The points of a depth image nearer than `far`, world frame: (N, 3) metres."""
        k = self.intrinsics
        row, column = np.nonzero(depth < 0.999 * k.far)
        z = depth[row, column]
        # The renderer samples a pixel at its lower left corner.
        x = (column - k.centre_x) * z / k.focal_length
        y = (row + 1.0 - k.centre_y) * z / k.focal_length
        in_camera = np.stack((x, y, z), axis=1)
        return in_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def _projection(k: Intrinsics) -> Matrix:
    """OpenGL's projection matrix of a pinhole camera (row-major)."""
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 2.0 * k.focal_length / k.width
    matrix[1, 1] = 2.0 * k.focal_length / k.height
    matrix[0, 2] = 1.0 - 2.0 * k.centre_x / k.width
    matrix[1, 2] = 2.0 * k.centre_y / k.height - 1.0
    matrix[2, 2] = -(k.far + k.near) / (k.far - k.near)
    matrix[2, 3] = -2.0 * k.far * k.near / (k.far - k.near)
    matrix[3, 2] = -1.0
    return matrix
