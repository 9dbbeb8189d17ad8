"""From a scene to the candidates that the network scores, on a device."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgegrasp_model.collision import UP
from edgegrasp_model.directions import allowed_ways
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.on_device.balls import DeviceCrop, crop_balls
from edgegrasp_model.on_device.candidates import (
    DeviceCandidates,
    drawn_back,
    edge_grasps,
    level_grasps,
)
from edgegrasp_model.on_device.centred import centred_grasps
from edgegrasp_model.on_device.collision import collides
from edgegrasp_model.on_device.sampling import sample_approach_points
from edgegrasp_model.on_device.scene import DeviceScene
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.preparation import (
    APPROACH_STREAM,
    CANDIDATE_STREAM,
    CODE,
    OVERSAMPLING,
    SAMPLING_ROUNDS,
    Round,
    add_count,
    preferred_rows,
    random_rows,
)
from edgegrasp_model.results import Outcome

Int8 = NDArray[np.int8]
Int64 = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class DeviceRound:
    """Every candidate around one set of approach points, and what has become of it so far."""

    candidates: DeviceCandidates  # E of them
    outcome: Int8  # (E,) CODE of its Outcome; RETURNED: still in

    @property
    def on_processor(self) -> Round:
        """The same in arrays."""
        return Round(self.candidates.on_processor, self.outcome)


@dataclass(frozen=True)
class DeviceSample:
    """The candidates to score, around one set of approach points; canonical frame."""

    approach_index: Tensor  # (A,) rows of the cloud
    crop: DeviceCrop
    candidates: DeviceCandidates  # E of them; `pair` is their contact's row in `crop`
    collision_free: Bools  # (E,)
    rounds: list[DeviceRound]  # the last of which holds these candidates
    row: Int64  # (E,) their rows in it


def sample_candidates(
    scene: DeviceScene,
    options: DetectOptions,
    gripper: Gripper,
    crop_radius: float,
    counts: dict[str, int],
    centre: bool = False,
) -> DeviceSample:
    """As `edgegrasp_model.preparation.sample_candidates`; the same seed draws the same ones."""
    rng_approach = np.random.default_rng([options.seed, APPROACH_STREAM])
    rng_candidates = np.random.default_rng([options.seed, CANDIDATE_STREAM])
    approach_rows = scene.approach_allowed.nonzero().squeeze(1)
    limit = OVERSAMPLING * options.num_candidates
    ignored = options.collision.mode == "ignore"
    rounds: list[DeviceRound] = []
    while True:
        chosen = sample_approach_points(
            scene.cloud.points[approach_rows],
            options.num_approach_points,
            options.sampling,
            rng_approach,
        )
        approach_index = approach_rows[chosen]
        crop = crop_balls(scene.cloud.points, approach_index, crop_radius)
        this = _constrained(scene, approach_index, crop, options, gripper, counts, centre)
        rounds.append(this)
        passed = np.flatnonzero(this.outcome == CODE[Outcome.RETURNED])
        row = passed[random_rows(len(passed), limit, rng_candidates)]
        this.outcome[passed] = CODE[Outcome.NOT_CHECKED]
        candidates = _taken(this.candidates, row)
        hands = candidates.T_cloud_hand
        free: Bools = ~collides(scene, hands, gripper, options.collision).cpu().numpy()
        this.outcome[row] = CODE[Outcome.NOT_SCORED]
        if not ignored:
            this.outcome[row[~free]] = CODE[Outcome.COLLISION]
        add_count(counts, "checked", len(row))
        add_count(counts, "collision_free", int(free.sum()))
        found = len(row) > 0 if ignored else free.any()
        # The same approach points would come up again, and the same candidates around them.
        exhausted = len(approach_rows) <= len(chosen) and len(passed) <= limit
        if found or exhausted or len(rounds) == SAMPLING_ROUNDS:
            break
    scored = preferred_rows(free, options, rng_candidates)
    this.outcome[row[scored]] = CODE[Outcome.RETURNED]
    counts["scored"] = len(scored)
    return DeviceSample(
        approach_index, crop, _taken(candidates, scored), free[scored], rounds, row[scored]
    )


def _constrained(
    scene: DeviceScene,
    approach_index: Tensor,
    crop: DeviceCrop,
    options: DetectOptions,
    gripper: Gripper,
    counts: dict[str, int],
    centre: bool,
) -> DeviceRound:
    """The edge grasps of some balls, and which satisfy every constraint but collision."""
    add_count(counts, "approach_points", len(approach_index))
    add_count(counts, "pairs", len(crop.ball_rows))
    pair = scene.contact_allowed[crop.ball_rows].nonzero().squeeze(1)
    add_count(counts, "in_contact_region", len(pair))
    pairs = approach_index[crop.ball_of_point[pair]], crop.ball_rows[pair]
    candidates = edge_grasps(scene.cloud, *pairs, gripper)
    support = scene.support
    if support is not None:
        level = level_grasps(scene.cloud, *pairs, support, gripper)
        candidates = DeviceCandidates.concatenate([candidates, level])
    candidates = replace(candidates, pair=pair[candidates.pair])
    if centre:
        centred = centred_grasps(scene.cloud.points, crop, candidates, gripper)
        candidates = DeviceCandidates.concatenate([candidates, centred])
    add_count(counts, "candidates", len(candidates))
    clear = torch.ones(len(candidates), dtype=torch.bool, device=pair.device)
    if support is not None:
        candidates, clear = drawn_back(candidates, support, gripper, options.collision.margin)
    told = torch.column_stack((candidates.approach, clear)).cpu().numpy()
    outcome = np.full(len(candidates), CODE[Outcome.RETURNED])
    outcome[told[:, 3] == 0] = CODE[Outcome.SUPPORT]
    wanted = options.approach_direction
    allowed = allowed_ways(-told[:, :3], wanted, UP, scene.frame.directions)
    outcome[~allowed] = CODE[Outcome.DIRECTION]
    add_count(counts, "in_direction", int(allowed.sum()))
    add_count(counts, "clear_of_support", int((outcome == CODE[Outcome.RETURNED]).sum()))
    return DeviceRound(candidates, outcome)


def _taken(candidates: DeviceCandidates, rows: Int64) -> DeviceCandidates:
    return candidates.take(torch.from_numpy(rows).to(candidates.pair.device))
