"""Which scored candidates come back, and in which order; near duplicates are found on a device."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.candidates import Candidates
from edgegrasp_model.collision import UP
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.on_device.collision import nearest_things
from edgegrasp_model.on_device.preparation import DeviceSample
from edgegrasp_model.on_device.scene import DeviceScene
from edgegrasp_model.options import DetectOptions, Suppression
from edgegrasp_model.ranking import ranked
from edgegrasp_model.selection import kept_of

Int64 = NDArray[np.int64]

BLOCK = 256  # candidates, best first, whose duplicates are looked for at a time


@dataclass(frozen=True)
class Selection:
    """What of E scored candidates comes back."""

    rows: Int64  # of the sample, best first
    candidates: Candidates  # all E
    clearance: NDArray[np.float32]  # of `rows`, metres
    outcome: NDArray[np.int8]  # (E,) codes


def select(
    scene: DeviceScene,
    sample: DeviceSample,
    score: NDArray[np.floating],
    gripper: Gripper,
    options: DetectOptions,
    counts: dict[str, int],
) -> Selection:
    """As `edgegrasp_model.selection.select`, with the clearances of what comes back."""
    candidates = sample.candidates.on_processor
    hands, there = candidates.T_cloud_hand, sample.candidates.T_cloud_hand
    T_cloud_tcp = hands @ gripper.T_hand_tcp
    clearance = nearest_things(scene, there, gripper) if options.order == "clearance" else None
    free = sample.collision_free | (options.collision.mode == "ignore")
    order = ranked(score, free, options.order, T_cloud_tcp[:, :3, 3] @ UP, clearance)

    def thinned(order: Int64, suppression: Suppression) -> tuple[Int64, Int64]:
        tcps = torch.from_numpy(T_cloud_tcp).to(there.device)
        return suppress(tcps, order, suppression, options.top_k)

    order, outcome = kept_of(order, score, options, thinned, counts)
    if clearance is None:
        chosen = torch.from_numpy(order).to(there.device)
        clearance = nearest_things(scene, there[chosen], gripper)
    else:
        clearance = clearance[order]
    return Selection(order, candidates, clearance, outcome)


def suppress(
    T_cloud_tcp: Tensor, order: Int64, suppression: Suppression, top_k: int
) -> tuple[Int64, Int64]:
    """As `edgegrasp_model.ranking.suppress`, with T_cloud_tcp (E, 4, 4) on a device.

    The device says who is near whom, a block of the best at a time; what is kept goes by turns,
    which is the processor's work.
    """
    poses = T_cloud_tcp[torch.from_numpy(order).to(T_cloud_tcp.device)]
    left, dropped = np.ones(len(order), dtype=bool), np.zeros(len(order), dtype=bool)
    kept: list[int] = []
    for start in range(0, len(order), BLOCK):
        if len(kept) == top_k:
            break
        near = _near(poses[start : start + BLOCK], poses, suppression)
        for row, duplicates in enumerate(near, start):
            if not left[row] or len(kept) == top_k:
                continue
            kept.append(row)
            left[row] = False
            dropped |= duplicates & left
            left &= ~duplicates
    return order[kept], order[dropped]


def _near(some: Tensor, poses: Tensor, suppression: Suppression) -> NDArray[np.bool_]:
    """Which poses (M, 4, 4) are near duplicates of which others: (b, M) for b of them."""
    if len(poses) == 0:
        return np.empty((len(some), 0), dtype=bool)
    apart = (some[:, None, :3, 3] - poses[None, :, :3, 3]).norm(dim=2)
    along = torch.einsum("bdk,mdk->bmk", some[:, :3, :3], poses[:, :3, :3])
    trace = along[..., 2] + (along[..., 0] + along[..., 1]).abs()
    angle = ((trace - 1) / 2).clamp(-1.0, 1.0).acos()
    near = (apart < suppression.translation) & (angle < suppression.rotation)
    result: NDArray[np.bool_] = near.cpu().numpy()
    return result
