"""The depth camera: viewpoints, the way from depth to points, and what planners are shown.

The surfaces of a depth image may be resampled. Its pixels lie farther apart on a surface seen at a
slant; a volume of signed distances, from which the reference system takes its clouds, has one point
wherever the distance changes its sign between two neighbours of a grid.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgegrasp_sim.engine import Intrinsics
from edgegrasp_sim.poses import Matrix

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


TRUNCATION = 4  # voxels; a point farther from a surface has no signed distance
CAMERA = Intrinsics()
FARTHEST = 0.999  # of the camera's range, from which there is nothing
_NEAR = 0.98  # of the truncation, within which a distance counts as one to a surface
TableView = Literal["known", "ransac", "seen", "around", "auto"]
_ALOFT = np.array([[0.0, 0.0, 0.015], [0.0, 0.0, 0.0]])  # metres the table is below the workspace
_AROUND = np.array([[-0.06], [0.06]])  # metres; wrong depths move points that far out
Float = TypeVar("Float", bound=np.floating)


@dataclass(frozen=True, slots=True)
class Observation:
    """The point cloud that one or several depth images show, and what a planner may know besides.

    Attributes:
        cloud: (N, 3) float32, world frame, metres; order of the pixels, one image after another.
        workspace: (2, 3) float32, lowest and highest corner of where grasps are looked for; not
            to be used where `table` is `auto`.
        table_height: metres; not to be used where `table` is `ransac` or `auto`.
        camera_positions: (V, 3) float32, every camera, world frame, metres.
        view_ids: (N,) int32, which camera saw each point.
        table: whether the cloud is cut off above the table (`known`) or holds it too: to be found
            (`ransac`), or to correct the depth scale by (`seen`; then the cloud is not cut off at
            the sides of the workspace either), or with all that is around it (`around`). `auto`:
            the same, and nothing is to be used but the cloud and the cameras.
        failed: (F, 4, 4) T_world_hand of the grasps that have failed in this round.
        pixels: (N,) the pixel of each point, row-major; None: several images, or cut off.
    """

    cloud: NDArray[np.float32]
    workspace: NDArray[np.float32]
    table_height: float
    camera_positions: NDArray[np.float32]
    view_ids: NDArray[np.int32]
    table: TableView = "known"
    failed: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4, 4)))
    pixels: NDArray[np.int64] | None = None

    @property
    def image(self) -> NDArray[np.float32]:
        """The cloud as the camera's image, (H, W, 3) with NaN holes; (N, 3) where it is none."""
        if self.pixels is None:
            return self.cloud
        image = np.full((CAMERA.height * CAMERA.width, 3), np.nan, dtype=np.float32)
        image[self.pixels] = self.cloud
        return image.reshape(CAMERA.height, CAMERA.width, 3)

    @property
    def camera_position(self) -> NDArray[np.float32]:
        """The first camera, world frame, metres: (3,)."""
        first: NDArray[np.float32] = self.camera_positions[0]
        return first


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

    def sample(self, rng: np.random.Generator, views: int = 1) -> list[Matrix]:
        """Draw a pose `T_world_camera` (4, 4), and spread others evenly over a full turn from it.

        The first is uniform in each coordinate.
        """
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


# The views of the reference evaluation.
EVALUATION_VIEWS = ViewRange((0.6, 0.75), (np.pi / 4, np.pi / 3), (0.0, np.pi))


def look_at(eye: Matrix, target: Matrix) -> Matrix:
    """Pose of a camera at `eye` that looks at `target` with world z up in the image.

    Camera axes: x to the right of the image, y down, z along the line of sight. Where that is
    vertical, the image's x is the world's.

    Returns:
        `T_world_camera`, (4, 4).

    Raises:
        ValueError: eye and target coincide.
    """
    sight = np.asarray(target, dtype=np.float64) - eye
    if np.linalg.norm(sight) < 1e-9:
        raise ValueError(f"cannot look from {eye} at {target}: choose two different points")
    right = np.cross(sight, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    z = sight / np.linalg.norm(sight)
    x = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, eye
    return T


def points_of(
    depth: NDArray[np.float64], T_world_camera: Matrix, camera: Intrinsics
) -> NDArray[np.float64]:
    """The points of a depth image (height, width) nearer than `far`: (N, 3) metres, world frame."""
    seen = depth < FARTHEST * camera.far
    # The renderer samples a pixel at its lower left corner.
    right = (np.arange(camera.width) - camera.centre_x) * depth
    down = (np.arange(1, camera.height + 1)[:, None] - camera.centre_y) * depth
    right, down = right[seen] / camera.focal_length, down[seen] / camera.focal_length
    in_camera = np.stack((right, down, depth[seen]))
    in_world = T_world_camera[:3, :3] @ in_camera + T_world_camera[:3, 3:]
    points: NDArray[np.float64] = in_world.T
    return points


def seen_box(workspace: Matrix, table: TableView) -> Matrix | None:
    """What is kept of a cloud: (2, 3) lowest and highest corner, or None: all of it."""
    if table in ("around", "auto"):
        return None
    box = workspace if table == "known" else workspace - _ALOFT
    return np.asarray(box + _AROUND if table == "seen" else box)


def crop(points: NDArray[Float], box: NDArray[np.floating], margin: float = 0.0) -> NDArray[Float]:
    """The points (N, 3) in a box (2, 3), lowest and highest corner, grown by a margin."""
    inside = (points >= box[0] - margin) & (points <= box[1] + margin)
    kept: NDArray[Float] = points[inside[:, 0] & inside[:, 1] & inside[:, 2]]
    return kept


def resample_surfaces(
    depth: Float64, T_world_camera: Matrix, intrinsics: Intrinsics, box: Matrix, voxel: float
) -> Float64:
    """Points where the signed distance along the line of sight changes its sign.

    Args:
        depth: (height, width) metres along the line of sight.
        T_world_camera: (4, 4) pose of the camera.
        intrinsics: of the camera.
        box: (2, 3) lowest and highest corner of the grid, world frame, metres.
        voxel: edge of the grid's cells, metres.

    Returns:
        (N, 3) metres, world frame, ordered by axis and cell.
    """
    first = np.floor(box[0] / voxel).astype(int)
    shape = np.ceil(box[1] / voxel).astype(int) - first + 1
    axes = [((first[k] + np.arange(shape[k]) + 0.5) * voxel).astype(np.float32) for k in range(3)]
    distance = _distances(depth, T_world_camera, intrinsics, axes, TRUNCATION * voxel)
    points = []
    for axis in range(3):
        here = np.moveaxis(distance, axis, 0)[:-1]
        there = np.moveaxis(distance, axis, 0)[1:]
        # NaN, the distance far from any surface, compares as false.
        crossed = np.moveaxis(here * there < 0, 0, axis)
        cell = np.nonzero(crossed)
        start = distance[cell]
        end = distance[tuple(index + (k == axis) for k, index in enumerate(cell))]
        place = np.stack([axes[k][index] for k, index in enumerate(cell)], axis=1)
        place[:, axis] += voxel * start / (start - end)
        points.append(place)
    return np.concatenate(points)


def _distances(
    depth: Float64,
    T_world_camera: Matrix,
    intrinsics: Intrinsics,
    axes: list[Float32],
    truncation: float,
) -> Float32:
    """Signed distance at each point of a grid, positive before a surface, NaN far from any.

    It is measured along the line of sight, to the depth of the nearest pixel.
    """
    k, T_camera_world = intrinsics, np.linalg.inv(T_world_camera).astype(np.float32)
    x, y, z = (_along(T_camera_world[row], axes) for row in range(3))
    x /= z
    y /= z
    # The renderer samples a pixel at its lower left corner.
    column = np.rint(x * k.focal_length + k.centre_x).astype(np.int32)
    row = np.rint(y * k.focal_length + k.centre_y - 1.0).astype(np.int32)
    height, width = depth.shape
    outside = (column < 0) | (column >= width) | (row < 0) | (row >= height)
    column[outside] = row[outside] = 0
    distance: Float32 = depth.astype(np.float32)[row, column] - z
    distance *= np.sqrt(1.0 + x * x + y * y)
    distance[outside | (np.abs(distance) > _NEAR * truncation)] = np.nan
    return distance


def _along(row: Float32, axes: list[Float32]) -> Float32:
    """One coordinate, in another frame, of every point of a grid.

    Args:
        row: (4,) of the transform into that frame.
        axes: the grid's coordinates along each of its axes.
    """
    first, second, third = (row[axis] * values for axis, values in enumerate(axes))
    whole: Float32 = first[:, None, None] + second[:, None] + third + row[3]
    return whole
