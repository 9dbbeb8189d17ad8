"""Training examples: the balls or hands of a view with their labels, as the network takes them."""

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from edgegrasp_model.candidates.edge_grasps import Candidates, crop_balls, edge_grasps
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import without_support
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.options import SupportPlane, Workspace
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.scene import near_workspace_side
from edgegrasp_training.ball_network import LENGTH_UNIT
from edgegrasp_training.views import UNTRIED, LabelledView

Rotations = Literal["any", "upright", "none"]

UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)
WORKSPACE = Workspace(min=(0.02, 0.02, 0.055), max=(0.28, 0.28, 0.3))  # and what they are cut to
SPARE_POINTS = 2  # times the network's points of a hand are kept, to pick from in each step
TRIED_WEIGHT = 4.0  # of a simulated label in the loss, beside a teacher's score of weight 1
SHAKEN_SHARE = 0.2  # of a held grasp's label that it only gets if it stays when shaken
FIRM_SHARE = 0.78  # of the held grasps that stay, where nobody shook
SUPPORT = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)  # the table of the simulated scenes


@dataclass(frozen=True)
class SeenByHands:
    """What the hand network is told of E grasps; half precision to keep many views in memory."""

    description: NDArray[np.float16]  # (E, F)
    points: NDArray[np.float16]  # (E, P, 6)
    point_count: NDArray[np.int64]  # (E,)


@dataclass(frozen=True)
class TriedGrasps:
    """The labelled edge grasps of one view, ready to be packed ball by ball."""

    cloud: Cloud
    candidates: Candidates  # E of them
    seen: SeenByHands | None  # for the hand network
    label: NDArray[np.float32]  # (E,) 0; held: 1, a little less where it did not stay when shaken
    turn: NDArray[np.float32]  # (3, 3) the cloud's axes to those of the frame detectors work in

    def without_support(self) -> "TriedGrasps":
        """The same, described as for a request that does not name the support plane."""
        if self.seen is None:
            return self
        unknown = without_support(self.seen.description).astype(np.float16)
        return replace(self, seen=replace(self.seen, description=unknown))

    def balls(self) -> NDArray[np.int64]:
        """Rows of the cloud that are approach points of labelled candidates, ascending."""
        return np.unique(self.candidates.approach_index)


@dataclass(frozen=True)
class Lessons:
    """Candidates of a view that a teacher has scored; compact, to keep many views in memory."""

    approach_index: NDArray[np.uint16]  # (E,) rows of the cloud
    contact_index: NDArray[np.uint16]  # (E,) rows of the cloud
    approach: NDArray[np.float16]  # (E, 3) unit, outward
    depth: NDArray[np.float16]  # (E,) metres
    chance: NDArray[np.float16]  # (E,) that it holds, as the teacher believes

    @staticmethod
    def none() -> "Lessons":
        """No candidate."""
        rows, numbers = np.empty(0, np.uint16), np.empty(0, np.float16)
        return Lessons(rows, rows, np.empty((0, 3), np.float16), numbers, numbers)

    def save(self, path: Path) -> None:
        """Write them; a reader sees the whole file or none, whoever else writes it too."""
        partial = path.with_suffix(f".{os.getpid()}.partial")
        with partial.open("wb") as file:
            np.savez_compressed(file, **{f.name: getattr(self, f.name) for f in fields(self)})
        partial.replace(path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as arrays:
            return cls(**{field.name: arrays[field.name] for field in fields(cls)})


class Packed(NamedTuple):
    """What a network is given in one step, and what it should say."""

    batch: BallBatch | HandBatch
    label: Tensor  # (E,) float32, what to say: above 1/2 where it held, or a teacher believes so
    weight: Tensor  # (E,) float32, in the loss


def tried_grasps(
    view: LabelledView, config: NetworkConfig, gripper: Gripper, *, viewpoint_known: bool = True
) -> TriedGrasps:
    """Build the tried candidates of a view, and what their hands see if the network wants that.

    Args:
        view: The view.
        config: The network to prepare for.
        gripper: The hand that tried them.
        viewpoint_known: Whether the request named the camera.
    """
    rows = view.tried()
    cloud = Cloud(view.points, view.normals)
    candidates = _candidates(view, cloud, rows, gripper)
    label = _labels(view)[rows[candidates.pair]]
    seen = None
    if config.architecture == "hand":
        batch = HandBatch.from_cloud(
            cloud,
            candidates,
            gripper,
            UP,
            SUPPORT,
            view.camera_position if viewpoint_known else None,
            near_workspace_side(view.points, WORKSPACE, UP),
            SPARE_POINTS * config.hand_points,
        )
        description, points = batch.description.numpy(), batch.points.numpy()
        seen = SeenByHands(
            description.astype(np.float16), points.astype(np.float16), batch.point_count.numpy()
        )
    return TriedGrasps(cloud, candidates, seen, label, _turn_of(view))


def _labels(view: LabelledView) -> NDArray[np.float32]:
    """What to say of each grasp: whether it holds, and of those that do, firm ones a little more.

    Most of the best candidates hold; the one that also stays when shaken is the one to execute.
    """
    held = view.success == 1
    firm = np.full(len(held), FIRM_SHARE)
    if view.firm is not None:
        firm = np.where(view.firm == UNTRIED, FIRM_SHARE, view.firm == 1)
    label: NDArray[np.float32] = (held * (1.0 - SHAKEN_SHARE * (1.0 - firm))).astype(np.float32)
    return label


def _turn_of(view: LabelledView) -> NDArray[np.float32]:
    """What turns a view's axes to those of the detector's frame, (3, 3)."""
    if len(view.points) == 0:
        return np.eye(3, dtype=np.float32)
    frame = CanonicalFrame.of_scene(view.points, UP, view.camera_position)
    return frame.directions(np.eye(3)).T.astype(np.float32)


def _candidates(
    view: LabelledView, cloud: Cloud, rows: NDArray[np.int64], gripper: Gripper
) -> Candidates:
    """The tried candidates; `pair` counts in `rows`."""
    approach_index, contact_index = view.approach_index[rows], view.contact_index[rows]
    if view.T_world_hand is None:
        return edge_grasps(cloud, approach_index, contact_index, gripper)
    pose = view.T_world_hand[rows]
    edge = view.points[contact_index] - view.points[approach_index]  # (E, 3)
    depth = np.maximum(np.einsum("ed,ed->e", edge, pose[:, :3, 2]), 0.0)
    pair = np.arange(len(rows), dtype=np.int64)
    return Candidates(pair, approach_index, contact_index, -pose[:, :3, 2], depth, pose)


def pack_balls(
    grasps: TriedGrasps,
    balls: NDArray[np.int64],
    config: NetworkConfig,
    lessons: Lessons | None = None,
) -> Packed:
    """Crop some balls of a view and pack the candidates in them, as networks of balls train.

    In the axes of detectors, but lengths are multiples of LENGTH_UNIT.

    Args:
        grasps: The labelled candidates of a view.
        balls: (A,) ascending rows of the cloud to crop around.
        config: Crop radius and k.
        lessons: Further candidates that a teacher has scored.
    """
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, balls))
    tried = grasps.candidates.take(rows)
    approach_index, contact_index = tried.approach_index, tried.contact_index
    approach, depth, label = tried.approach, tried.depth, grasps.label[rows]
    weight = np.ones(len(rows), dtype=np.float32)
    if lessons is not None:
        taught = np.flatnonzero(np.isin(lessons.approach_index, balls))
        approach_index = np.append(approach_index, lessons.approach_index[taught])
        contact_index = np.append(contact_index, lessons.contact_index[taught])
        approach = np.concatenate([approach, lessons.approach[taught]], dtype=np.float32)
        depth = np.append(depth, lessons.depth[taught])
        label = np.append(label, lessons.chance[taught])
        weight = np.append(TRIED_WEIGHT * weight, np.ones(len(taught), dtype=np.float32))
    crop = crop_balls(grasps.cloud.points, balls, config.crop_radius)
    size = len(grasps.cloud.points)
    keys = crop.ball_of_point * size + crop.ball_rows  # ascending
    wanted = np.searchsorted(balls, approach_index) * size + contact_index
    contact = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    inside = keys[contact] == wanted
    batch = BallBatch.from_cloud(
        grasps.cloud.points,
        grasps.cloud.normals,
        balls,
        crop,
        contact[inside],
        approach[inside],
        depth[inside],
        config.k,
    )
    batch = replace(batch, points=batch.points / LENGTH_UNIT, depth=batch.depth / LENGTH_UNIT)
    label, weight = label[inside].astype(np.float32), weight[inside]
    return Packed(turned(batch, grasps.turn), torch.from_numpy(label), torch.from_numpy(weight))


def pack_hands(
    grasps: TriedGrasps,
    balls: NDArray[np.int64],
    config: NetworkConfig,
    rng: np.random.Generator | None = None,
) -> Packed:
    """Pack what the hands of the candidates of some balls see.

    Args:
        grasps: The labelled candidates of a view, with what their hands see.
        balls: (A,) rows of the cloud.
        config: Points of each hand.
        rng: Picks points of each hand at random; evenly over the cloud's order without it.
    """
    seen = grasps.seen
    if seen is None:
        raise ValueError("grasps: got none that hands have seen. Build them for this network.")
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, balls))
    points, count = seen.points[rows], seen.point_count[rows]
    limit, slot = config.hand_points, np.arange(seen.points.shape[1])
    if rng is None:
        order = slot * np.maximum(count[:, None], limit) // limit  # (E, P)
    else:
        there = slot < count[:, None]
        order = np.argsort(np.where(there, rng.random(there.shape, dtype=np.float32), 2.0), axis=1)
    chosen = np.take_along_axis(points, order[:, :limit, None], axis=1)
    batch = HandBatch(
        torch.from_numpy(seen.description[rows].astype(np.float32)),
        torch.from_numpy(chosen.astype(np.float32)),
        torch.from_numpy(np.minimum(count, limit)),
    )
    return Packed(batch, torch.from_numpy(grasps.label[rows]), torch.ones(len(rows)))


def turned(batch: BallBatch, turn: NDArray[np.float32]) -> BallBatch:
    """Turn all balls of a batch by one rotation (3, 3)."""
    transposed = torch.from_numpy(turn.T.copy())
    return replace(
        batch,
        points=batch.points @ transposed,
        normals=batch.normals @ transposed,
        approach=batch.approach @ transposed,
    )


def random_turn(rotations: Rotations, rng: np.random.Generator) -> NDArray[np.float32]:
    """A rotation (3, 3) to turn training balls by: any (paper section IV-D), about up, or none."""
    match rotations:
        case "any":
            turn = Rotation.random(rng=rng)
        case "upright":
            turn = Rotation.from_rotvec(rng.uniform(0.0, 2 * np.pi) * UP)
        case "none":
            turn = Rotation.identity()
    return turn.as_matrix().astype(np.float32)
