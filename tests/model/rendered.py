"""Scenes of solid boxes, as a depth camera sees them."""

import numpy as np
from scipy.spatial.transform import Rotation

from edgegrasp_sim.camera import look_at

WIDTH, HEIGHT, FOCAL_LENGTH = 320, 240, 270.0
NOISE = 0.0015  # metres at one metre; grows with the square of the distance


class SolidBox:
    """A box, turned about z; world frame, metres, z up."""

    def __init__(self, center: object, half: object, yaw: float = 0.0) -> None:
        self.center, self.half = np.asarray(center, float), np.asarray(half, float)  # (3,) each
        self.turn = Rotation.from_euler("z", yaw).as_matrix()  # R_world_box

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (N,) of points (N, 3) from the box; 0 inside."""
        apart = np.abs((points - self.center) @ self.turn) - self.half
        return np.linalg.norm(np.maximum(apart, 0.0), axis=1)


box = SolidBox


def table(half_width: float = 0.5, half_depth: float = 0.4) -> SolidBox:
    """A table top at z = 0."""
    return box((0, 0, -0.015), (half_width, half_depth, 0.015))


def boxes_on_table(seed: int) -> list[SolidBox]:
    """Four boxes a hand can grasp, standing apart from each other on z = 0."""
    rng = np.random.default_rng(seed)
    placed: list[SolidBox] = []
    while len(placed) < 4:
        half = rng.uniform([0.012, 0.02, 0.025], [0.025, 0.05, 0.07])
        x, y = rng.uniform([-0.2, -0.15], [0.2, 0.15])
        new = box((x, y, half[2]), half, rng.uniform(0, np.pi))
        if all(np.hypot(*(new.center - other.center)[:2]) > 0.15 for other in placed):
            placed.append(new)
    return placed


def camera(polar: float, azimuth: float, distance: float) -> np.ndarray:
    """T_world_camera (4, 4), looking at the origin; x right, y down, z forward."""
    level = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return look_at(distance * np.array([*level, np.cos(polar)]), np.zeros(3))


def to_world(T_world_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the camera's frame in the world's."""
    return points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def render(boxes: list[SolidBox], T_world_camera: np.ndarray, seed=0, zoom=1.0) -> np.ndarray:
    """The organised cloud (HEIGHT, WIDTH, 3) in the camera's frame, NaN where nothing is seen."""
    row, column = np.indices((HEIGHT, WIDTH))
    x, y = np.array([column - WIDTH / 2, row - HEIGHT / 2]) / (FOCAL_LENGTH * zoom)
    rays = np.stack([x, y, np.ones((HEIGHT, WIDTH))], axis=-1).reshape(-1, 3)
    in_world, eye = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    depth = np.full(len(rays), np.inf)
    for one in boxes:
        start, way = (eye - one.center) @ one.turn, in_world @ one.turn
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        first, last = (-one.half - start) / way, (one.half - start) / way
        enter, leave = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
        depth = np.where((enter < leave) & (enter > 0.05), np.minimum(depth, enter), depth)
    depth[~np.isfinite(depth)] = np.nan
    noise = np.random.default_rng(seed).normal(0.0, NOISE, len(depth))
    points = rays * (depth + noise * depth**2)[:, None]
    return points.reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def seen_box(boxes: list[SolidBox], pose: np.ndarray) -> np.ndarray:
    """The row in `boxes` (H * W,) of the one that each pixel shows; -1: none."""
    depth = np.stack([np.nan_to_num(render([one], pose)[..., 2], nan=np.inf) for one in boxes])
    return np.where(np.isfinite(depth.min(axis=0)), depth.argmin(axis=0), -1).ravel()


def wavy(distance: float) -> np.ndarray:
    """Depths (HEIGHT, WIDTH) of an uneven wall before the camera."""
    row, column = np.indices((HEIGHT, WIDTH))
    depth = distance * (1 + 0.05 * np.sin(column / 9) * np.cos(row / 11))
    return depth.astype(np.float32)


SCENE = render([table(), *boxes_on_table(3)], camera(0.7, -1.2, 0.85))
ROOM = [box(3 * way, 3.1 - 3 * np.abs(way)) for way in np.concatenate([np.eye(3), -np.eye(3)])]
ROOM_INSIDE = render(ROOM, camera(1.2, 0.3, 0.4))


def depth_image(cloud: np.ndarray) -> dict[str, object]:
    """A rendered cloud (H, W, 3) as one of `depth_images`."""
    height, width = cloud.shape[:2]
    camera_matrix = (FOCAL_LENGTH, FOCAL_LENGTH, width / 2, height / 2)
    return {"depth": cloud[..., 2], "intrinsics": camera_matrix}
