"""What a camera could not see, on a device; `edgegrasp_model.hidden_space` in tensors."""

from typing import NamedTuple

import torch
from torch import Tensor

from edgegrasp_model.collision import UP
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hidden_space import (
    BEHIND,
    CELL,
    DEEP,
    FARTHEST,
    HALF,
    SPLAT,
    STEEP,
    probes,
)
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.on_device.scene import DeviceScene

AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
SIDE = 2 * HALF + 1  # cells across; one size for all scenes


def hidden_shares(scene: DeviceScene, T_cloud_hand: Tensor, gripper: Gripper) -> list[Tensor]:
    """How much of each part of a hand, and of the space around it, the camera did not see.

    Args:
        scene: Cloud and camera.
        T_cloud_hand: (E, 4, 4).
        gripper: Fingers open to its maximum.

    Returns:
        For each of the parts of `probes` its mean (E,).
    """
    parts = probes(gripper)
    points, device = scene.cloud.points, T_cloud_hand.device
    if scene.viewpoint is None or len(points) == 0:
        return [torch.zeros(len(T_cloud_hand), device=device)] * len(parts)
    frame = _map_frame(points, torch.from_numpy(scene.viewpoint).to(device))
    surface = _depth_map(points, frame)
    probe = constant([row for part in parts for row in part.tolist()], device)  # (S, 3)
    position = probe @ T_cloud_hand[:, :3, :3].transpose(1, 2) + T_cloud_hand[:, None, :3, 3]
    cell, distance = _seen(position.reshape(-1, 3), frame)
    inside = (cell.abs() <= HALF).all(dim=1)
    place = torch.where(inside, _flat(cell.clamp(-HALF, HALF)), 0)
    first = torch.where(inside, surface[place], torch.inf)
    hidden = ((distance - first - BEHIND) / DEEP).clamp(0.0, 1.0).view(len(T_cloud_hand), -1)
    return [part.mean(dim=1) for part in torch.split(hidden, [len(part) for part in parts], dim=1)]


class _MapFrame(NamedTuple):
    """`edgegrasp_model.hidden_space.MapFrame` in tensors."""

    viewpoint: Tensor  # (3,)
    axes: Tensor  # (3, 3)
    cell: Tensor  # ()


def _map_frame(points: Tensor, viewpoint: Tensor) -> _MapFrame:
    """A camera (3,) that looks at the middle of points (N, 3)."""
    up, axes = (constant(rows, points.device, torch.float64) for rows in (UP.tolist(), AXES))
    way = points.mean(dim=0, dtype=torch.float64) - viewpoint
    distance = torch.linalg.vector_norm(way).clamp_min(1e-6)
    ahead = way / distance
    across = torch.linalg.cross(ahead, up)
    least = axes.index_select(0, ahead.abs().argmin().view(1)).squeeze(0)
    steep = torch.linalg.vector_norm(across) < STEEP * torch.linalg.vector_norm(up)
    across = torch.where(steep, torch.linalg.cross(ahead, least), across)
    across = across / torch.linalg.vector_norm(across)
    axes = torch.stack([across, torch.linalg.cross(ahead, across), ahead]).float()
    return _MapFrame(viewpoint, axes, (CELL / distance).float())


def _depth_map(points: Tensor, frame: _MapFrame) -> Tensor:
    """Distance of the first surface in each cell, row by row; inf where nothing was seen."""
    cell, distance = _seen(points, frame)
    reach = torch.arange(-SPLAT, SPLAT + 1, device=points.device)
    shift = torch.cartesian_prod(reach, reach)  # (25, 2)
    place = cell.unsqueeze(1) + shift  # (N, 25, 2)
    inside = (place.abs() <= HALF).all(dim=2)
    far = torch.where(inside, distance.unsqueeze(1), torch.inf)
    depth = torch.full((SIDE * SIDE,), torch.inf, device=points.device)
    index = _flat(place.clamp(-HALF, HALF)).flatten()
    return depth.scatter_reduce(0, index, far.flatten(), "amin")


def _seen(positions: Tensor, frame: _MapFrame) -> tuple[Tensor, Tensor]:
    """The cells (N, 2) that positions (N, 3) lie in, and their distance (N,) from the camera."""
    along = (positions - frame.viewpoint) @ frame.axes.T
    tangents = along[:, :2] / along[:, 2:].clamp_min(1e-6)
    cell = (tangents / frame.cell).floor().clamp(-FARTHEST, FARTHEST)
    return cell.long(), torch.linalg.vector_norm(along, dim=1)


def _flat(cell: Tensor) -> Tensor:
    """Places of cells (..., 2) in a map that is laid out row by row."""
    return (cell[..., 0] + HALF) * SIDE + cell[..., 1] + HALF
