"""HandNet: scores edge grasps from the points near each hand, in the hand's own frame.

It is a PointNet over the points around the fingers, combined with a description of the hand. The
paper's network shares one ball among all its edge grasps and has to learn what a rotation does.
This network sees each edge grasp in the frame of its own hand, so it is invariant under rotations,
translations and reflections of the whole scene by construction. The description contains how many
points the hand would hit, what lies between its fingers, from where that was seen, how the hand is
oriented to gravity and support, how much of the space around it the camera did not see, the hand's
own dimensions, and the visible extent of the object around it.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.candidates.collision import FINGER_SURROUNDINGS, HandView, hand_views
from edgegrasp_model.candidates.edge_grasps import SURFACE_GAP, Candidates, support_clearance
from edgegrasp_model.gripper import APPROACH_LENGTH, Gripper
from edgegrasp_model.kernels import compiled
from edgegrasp_model.networks import layers
from edgegrasp_model.networks.config import HAND_DESCRIPTION_SIZE, NetworkConfig
from edgegrasp_model.scene.cloud import UP, unit
from edgegrasp_model.scene.network import FAST
from edgegrasp_model.scene.scene import Surroundings
from edgegrasp_model.scene.support import heights_over
from edgegrasp_model.unseen import unseen_space, visible_extents

# The network
POINT_UNIT = 0.05  # metres; scale of the positions around the fingers
DROPOUT = 0.1  # dropout of the classifier's inputs
HANDS_AT_A_TIME = 64  # hands at a time, so that the work stays in cache

# The description
AXIS_RADIUS = 0.001  # metres from the approach axis, on which the approach point itself lies
SLAB_THICKNESS = 0.004  # metres; thickness of the first layer each finger would touch
MIN_FACING = 0.7  # cosine from which a normal faces a finger
ABOVE_CAMERA = 0.001  # metres over the camera
# Metres beyond the pads' sides, the open fingers' inner faces, the palm and the tips.
BESIDE_PADS, OUTSIDE_FINGERS, BEHIND_PALM, BEYOND_TIPS = 0.027, 0.06, 0.026, 0.012
UNKNOWN_HEIGHT = 0.10  # metres; heights are clipped here, and unknown ones get this value
HEIGHT_NUMBERS = slice(58, 61)  # numbers that are heights over the support plane
UNSEEN_NUMBERS = slice(65, 67)  # unseen metres outward from what each finger touches first


@dataclass(frozen=True)
class HandBatch:
    """E edge grasps, each with the points near its hand. Metres."""

    description: Tensor  # (E, F) float32, F at least what the network reads
    points: Tensor  # (E, P, 6) float32, positions and normals around the fingers, hand frame
    point_count: Tensor  # (E,) int64, how many of the P are points; zeros follow

    @classmethod
    def from_hands(
        cls,
        scene: Surroundings,
        candidates: Candidates,
        gripper: Gripper,  # open to its maximum
        num_points: int,
        description_size: int = HAND_DESCRIPTION_SIZE,
    ) -> Self:
        """Describe each candidate's hand and its surroundings, with at most `num_points` points."""
        hands = candidates.T_cloud_hand
        view = hand_views(scene.cloud, hands, gripper)
        side = np.ones(len(hands), dtype=np.float32)
        if len(scene.viewpoints) == 1:
            # If a hand approaches straight from the camera, up decides instead of rounding errors.
            toward = scene.viewpoints[0] + ABOVE_CAMERA * UP - hands[:, :3, 3]
            along_x = np.einsum("ed,ed->e", toward, hands[:, :3, 0])
            side = np.where(along_x < 0.0, -1.0, 1.0).astype(np.float32)
        description = describe_hands(scene, candidates, gripper, view, side, description_size)
        x, y = gripper.pad_half_width + BESIDE_PADS, gripper.max_opening / 2 + OUTSIDE_FINGERS
        low, high = (-x, -y, gripper.seen_palm_z - BEHIND_PALM), (x, y, gripper.tip_z + BEYOND_TIPS)
        box = np.array([low, high, (0.0, 0.0, gripper.tip_z)], dtype=np.float32)
        points = _around_fingers(view, scene.cloud.normals, hands, side, box, num_points)
        return cls(*map(torch.from_numpy, (description, *points)))

    @classmethod
    def synthetic(cls, config: NetworkConfig) -> Self:
        """A fixed batch of 32 hands, for checking that a network still computes the same logits."""
        rng = np.random.default_rng(0)
        description = rng.normal(size=(32, config.description_size))
        points = rng.normal(size=(32, config.hand_points, 6)) * (0.02, 0.02, 0.02, 1.0, 1.0, 1.0)
        count = rng.integers(0, config.hand_points + 1, 32)
        arrays = description.astype(np.float32), points.astype(np.float32), count
        return cls(*map(torch.from_numpy, arrays))

    def to(self, device: torch.device | str) -> "HandBatch":
        """Moves every tensor to a device."""
        return HandBatch(*(tensor.to(device) for tensor in vars(self).values()))


class HandNet(nn.Module):
    """Scores E edge grasps, with P points around the fingers of each."""

    mean: Tensor  # (F,) of the training data's descriptions
    std: Tensor  # (F,)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(config.description_size))
        self.register_buffer("std", torch.ones(config.description_size))
        self.point_encoder = layers.mlp((6, *config.hand_widths))
        inputs = config.description_size + 2 * config.hand_widths[-1]
        self.classifier = layers.mlp((inputs, *config.classifier_widths, 1))

    def forward(self, batch: HandBatch, left_out: torch.Generator | None = None) -> Tensor:
        """Logits (E,) of success; in training, `left_out` draws the inputs that dropout removes."""
        known = batch.description[:, : self.config.description_size]
        description = (known - self.mean) / self.std  # (E, F)
        encoder, chunks = layers.packed(self.point_encoder, FAST), []
        for points, count in layers.split_chunks(HANDS_AT_A_TIME, batch.points, batch.point_count):
            positions, normals = torch.split(points, 3, dim=2)
            encoded = encoder(torch.cat((positions / POINT_UNIT, normals), dim=2))  # (E, P, C)
            if layers.float32_inference(points):
                pooled = points.new_zeros(len(encoded), 2 * encoded.shape[2])
                _pool(encoded.float().numpy(), count.numpy(), pooled.numpy())
            else:
                there = torch.arange(points.shape[1], device=points.device) < count.unsqueeze(1)
                features = F.relu(encoded) * there.unsqueeze(2)  # (E, P, C), none below 0
                mean = features.sum(dim=1) / count.clamp_min(1).unsqueeze(1)  # (E, C)
                pooled = torch.cat((layers.maximum(features, dim=1), mean), dim=1)
            chunks.append(pooled)  # (E, 2 C): maximum and mean over the hand's points
        seen = torch.cat((description, torch.cat(chunks)[: len(description)]), dim=1)
        if left_out is not None:
            draws = torch.rand(seen.shape, generator=left_out, device=left_out.device)
            seen = seen * (draws >= DROPOUT).to(seen.device) / (1.0 - DROPOUT)
        classifier = layers.packed(self.classifier, FAST)
        logits = layers.map_chunks(classifier, seen, layers.EDGE_ROWS)
        return logits.squeeze(1)  # (E,)


@compiled("contract", "nsz")
def _pool(features: Float32, count: Int64, pooled: Float32) -> None:
    """Maximum and mean of the ReLU of the first `count` (E,) of features (E, P, C)."""
    channels = features.shape[2]
    zero = np.float32(0.0)
    for e in range(len(count)):
        largest, mean = pooled[e, :channels], pooled[e, channels:]
        for p in range(count[e]):
            here = features[e, p]
            for c in range(channels):
                value = max(here[c], zero)
                largest[c] = max(largest[c], value)
                mean[c] += value
        for c in range(channels):
            mean[c] /= np.float32(max(count[e], 1))


# The description of a hand


def describe_hands(
    scene: Surroundings,  # of the hands
    candidates: Candidates,  # E candidates
    gripper: Gripper,  # fingers open to its maximum
    view: HandView,  # of the same candidates
    side: Float32,  # (E,) 1 or -1, the factor on a hand's x that puts it on the positive side
    size: int,  # numbers that the network reads; the extents, which come last, may be skipped
) -> Float32:
    """The description (E, F) of candidates: log(1 + counts), metres and cosines."""
    cloud, up, hands = scene.cloud, scene.up, candidates.T_cloud_hand
    mirrored = hands[:, :3, :3].copy()
    mirrored[:, :, 0] *= side[:, None]
    boxes = gripper.open_boxes.astype(np.float32)
    first, last = len(gripper.hand.boxes), len(gripper.hand.boxes) + len(gripper.finger.boxes)
    across = gripper.pad_half_width, gripper.max_opening / 2
    lengths = map(np.float32, (*across, gripper.seen_palm_z, gripper.tip_z, gripper.max_tip_z))
    hand = _Hand(boxes[:first], boxes[first:last], *lengths)
    looked = view, cloud.normals, mirrored, side, scene.at_side, hand
    seen, first_touch, runs = _look_from_each(*looked)
    unseen = unseen_space(scene.depths, hands, first_touch, gripper)
    toward = np.zeros((len(mirrored), 3), dtype=np.float32)
    if len(scene.viewpoints) == 1:
        toward = unit(scene.viewpoints[0] - hands[:, :3, 3])
    ups = np.broadcast_to(up / np.linalg.norm(up), toward.shape)
    length, swing = gripper.tip_z - gripper.palm_z, gripper.max_tip_z - gripper.tip_z
    thick = gripper.finger_thickness
    measures = gripper.max_opening, length, gripper.pad_half_width, thick, swing  # of the gripper
    columns = [
        *seen.T,
        *np.einsum("ed,edk->ke", toward, mirrored),  # 0 where the camera is unknown
        *np.einsum("ed,edk->ke", ups, mirrored),
        *unseen.parts,
        *_stance(scene, candidates, gripper),
        # Older networks read only the first numbers, so new ones are appended here.
        *unseen.ways,
        *unseen.depths,
        *unseen.beyond,
        unseen.free,
        *runs.T,
        *np.tile(measures, (len(candidates), 1)).T,
    ]
    if size > len(columns):
        of_object = cloud.points, scene.object_of_point, candidates.contact_index
        columns += [*visible_extents(*of_object, hands, side, gripper, up).T]
    return np.stack(columns, axis=1).astype(np.float32)


class _Hand(NamedTuple):
    """The open gripper as the compiled loops read it; metres."""

    boxes: Float32  # (B, 2, 3) of the hand
    fingers: Float32  # (F, 2, 3) of the finger on the side of positive y
    half: np.float32  # half the width of a pad
    inner: np.float32  # y of that finger's inner face
    palm: np.float32  # z
    tip: np.float32
    end: np.float32  # greatest z of the fingertips while closing


def _stance(scene: Surroundings, candidates: Candidates, gripper: Gripper) -> list[Float32]:
    """The edge itself, the hand's orientation to gravity, and its height over the support plane."""
    cloud, support, up = scene.cloud, scene.support, scene.up / np.linalg.norm(scene.up)
    pose = candidates.T_cloud_hand
    contact = cloud.points[candidates.contact_index]  # (E, 3)
    edge = contact - cloud.points[candidates.approach_index]
    columns = [
        candidates.depth,
        np.linalg.norm(edge, axis=1),
        np.einsum("ed,ed->e", edge, pose[:, :3, 1]),
        candidates.approach @ up,
        np.abs(pose[:, :3, 1] @ up),
    ]
    if support is None:
        return columns + [np.full(len(pose), UNKNOWN_HEIGHT, dtype=np.float32)] * 3
    tips = pose[:, :3, 3] + gripper.tip_z * pose[:, :3, 2]
    clearance = support_clearance(pose, candidates.opening, support, gripper)
    heights = heights_over(support, tips), heights_over(support, contact), clearance
    return columns + [np.clip(h, -UNKNOWN_HEIGHT, UNKNOWN_HEIGHT) for h in heights]


@compiled("contract")
def _look_from_each(
    view: HandView, normals: Float32, axes: Float32, side: Float32, cut: Bools, hand: _Hand
) -> tuple[Float32, Float32, Float32]:
    """Describe points in the frames of hands with axes (E, 3, 3), x mirrored if `side` (E,) is -1.

    Returns 37 numbers (E, 37): those of `_count_hits`, those of `_measure_between`, and how many
    points between the fingers lie where the workspace cuts objects off, `cut` (N,), all counts n as
    log(1 + n); then greatest and least y between the fingers (E, 2), and runs (E, 3).
    """
    seen, first_touch = (
        np.zeros((len(side), 37), np.float32),
        np.zeros((len(side), 2), np.float32),
    )
    runs = np.zeros((len(side), 3), np.float32)
    for e in range(len(side)):
        start, stop = view.bounds[e], view.bounds[e + 1]
        x, y, z = view.position[:, start:stop]
        x = side[e] * x
        _count_hits(x, y, z, hand, seen[e, :7])
        across, ahead = np.abs(y) < hand.inner, z > hand.palm
        beside = np.abs(x) < hand.half + FINGER_SURROUNDINGS
        pads = across & ahead & beside & (z < hand.tip + FINGER_SURROUNDINGS)
        wide = np.flatnonzero(across & ahead & (np.abs(x) < 3 * hand.half) & (z < hand.end))
        points, facing = np.empty((2, 3, len(wide)), dtype=np.float32)
        points[0], points[1], points[2] = x[wide], y[wide], z[wide] - hand.palm
        for d in range(3):
            for i in range(len(wide)):
                n = normals[view.row[start + wide[i]]]
                facing[d, i] = n[0] * axes[e, 0, d] + n[1] * axes[e, 1, d] + n[2] * axes[e, 2, d]
        _measure_between(points, facing, hand, seen[e, 7:36])
        seen[e, 36] = np.log1p(np.sum(cut[view.row[start:stop]] & pads))
        _runs_along(points[1][np.abs(points[0]) < hand.half], first_touch[e], runs[e])
    return seen, first_touch, runs


@compiled("contract")
def _count_hits(x: Float32, y: Float32, z: Float32, hand: _Hand, hits: Float32) -> None:
    """Count points in the open fingers, in the hand, near each finger, on the approach, ahead."""
    on_way = _in_any(hand.boxes, x, y, z, 0.0, np.inf)
    for finger in range(2):
        outward = y if finger == 0 else -y
        on_way |= _in_any(hand.fingers, x, outward, z, 0.0, APPROACH_LENGTH)
        hits[finger] = np.sum(_in_any(hand.fingers, x, outward, z, 0.0, 0.0))
        hits[3 + finger] = np.sum(_in_any(hand.fingers, x, outward, z, FINGER_SURROUNDINGS, 0.0))
    hits[2] = np.sum(_in_any(hand.boxes, x, y, z, 0.0, 0.0))
    hits[5] = np.sum(on_way)
    hits[6] = np.sum((np.abs(x) < hand.half) & (np.abs(y) < hand.inner) & (z >= hand.tip))
    hits[:] = np.log1p(hits)


@compiled("contract")
def _in_any(
    boxes: Float32, x: Float32, y: Float32, z: Float32, around: float, behind: float
) -> Bools:
    """Which points lie in any of the boxes, grown by `around`, but at the back by `behind`."""
    inside = np.zeros(len(x), dtype=np.bool_)
    grown, longer = np.float32(around), np.float32(behind)
    for b in range(len(boxes)):
        low, high = boxes[b, 0] - grown, boxes[b, 1] + grown
        back = boxes[b, 0, 2] - longer
        for i in range(len(x)):
            level = (x[i] > low[0]) & (x[i] < high[0]) & (y[i] > low[1]) & (y[i] < high[1])
            inside[i] |= level & (z[i] > back) & (z[i] < high[2])
    return inside


@compiled("contract")
def _measure_between(points: Float32, normals: Float32, hand: _Hand, numbers: Float32) -> None:
    """Extent, middle and normals of points (3, P), z from the palm, that the fingers would touch.

    Points between the pads: their number; greatest, least and mean x, y and z. All points, in a
    strip three pads wide: their number; greatest, least and mean x. Points between the pads: mean
    absolute x and y and mean z of the normals; how many face each finger; mean y of the normals on
    either side of the hand's axis. Points that each finger touches first: number, mean y of the
    normals, mean z and mean x.
    """
    length = hand.end - hand.palm
    between = np.flatnonzero(np.abs(points[0]) < hand.half)
    inside, normal = points[:, between], normals[:, between]
    x, y, z = inside
    ny = normal[1]
    numbers[0] = np.log1p(len(between))
    for d in range(3):
        empty = np.float32(0.0) if d < 2 else length
        _extent(inside[d], empty, numbers[1 + 3 * d : 4 + 3 * d])
    numbers[10] = np.log1p(len(points[0]))
    _extent(points[0], np.float32(0.0), numbers[11:14])
    numbers[14], numbers[15] = _mean(np.abs(normal[0])), _mean(np.abs(ny))
    numbers[16] = _mean(normal[2])
    numbers[17], numbers[18] = np.log1p(np.sum(ny > MIN_FACING)), np.log1p(np.sum(ny < -MIN_FACING))
    numbers[19], numbers[20] = _mean(ny[y > AXIS_RADIUS]), _mean(ny[y < -AXIS_RADIUS])
    for finger in range(2):
        first = y > numbers[4] - SLAB_THICKNESS if finger == 0 else y < numbers[5] + SLAB_THICKNESS
        count, at = np.sum(first), 21 + 4 * finger
        numbers[at], numbers[at + 1] = np.log1p(count), _mean(ny[first])
        numbers[at + 2] = _mean(z[first]) if count else length / 2
        numbers[at + 3] = _mean(x[first])


@compiled("contract")
def _extent(values: Float32, empty: np.float32, numbers: Float32) -> None:
    """Greatest, least and mean; if there is no value: 0, `empty` and half of `empty`."""
    numbers[0], numbers[1], numbers[2] = 0.0, empty, empty / 2
    if len(values):
        numbers[0], numbers[1], numbers[2] = values.max(), values.min(), _mean(values)


@compiled("contract")
def _mean(values: Float32) -> float:
    """The mean; 0 without values."""
    total = 0.0
    for i in range(len(values)):
        total += values[i]
    return total / max(len(values), 1)


@compiled("contract")
def _runs_along(y: Float32, ends: Float32, runs: Float32) -> None:
    """The longest gap along y, and the length up to a gap of what each finger touches first.

    Also the greatest and the least y, which stay 0 without points.
    """
    along = np.sort(y)
    if len(along) == 0:
        return
    low, high = along[0], along[-1]
    ends[0], ends[1] = high, low
    runs[1], runs[2] = high - low, high - low
    whole = True
    for i in range(1, len(along)):
        apart = along[i] - along[i - 1]
        runs[0] = max(runs[0], apart)
        if apart > SURFACE_GAP:
            runs[1] = high - along[i]
            if whole:
                runs[2] = along[i - 1] - low
            whole = False


@compiled("contract")
def _around_fingers(
    view: HandView, normals: Float32, T_cloud_hand: Float32, side: Float32, box: Float32, limit: int
) -> tuple[Float32, Int64]:
    """The points in a box around the fingers of hands (E, 4, 4); x is multiplied by `side` (E,).

    `box` (3, 3) are its corners and the origin, between the fingertips. At most `limit` points are
    kept for each hand, spread evenly over the cloud's order. Returns (E, limit, 6) positions in
    metres and normals, in hand frames, zeros after the last; and their number (E,).
    """
    points, count = np.zeros((len(side), limit, 6), np.float32), np.zeros(len(side), np.int64)
    low, high, origin = box
    for e in range(len(side)):
        start, stop = view.bounds[e], view.bounds[e + 1]
        x, y, z = view.position[:, start:stop]
        inside = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        near = start + np.flatnonzero(inside & (z > low[2]) & (z < high[2]))
        count[e] = min(len(near), limit)
        for slot in range(count[e]):
            # If there are too many, an even selection in the cloud's order.
            p = near[((slot + 1) * len(near) - 1) // limit if len(near) > limit else slot]
            for d in range(3):
                points[e, slot, d] = view.position[d, p] - origin[d]
                for k in range(3):
                    points[e, slot, 3 + d] += normals[view.row[p], k] * T_cloud_hand[e, k, d]
            points[e, slot, 0] *= side[e]
            points[e, slot, 3] *= side[e]
    return points, count
