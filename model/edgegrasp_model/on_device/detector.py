"""The detector whose every stage after the upload runs on one device."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from edgegrasp_model.assembly import Drawn, debug_info, grasps_in_cloud
from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.cloud_input import check_cloud
from edgegrasp_model.detector import NO_APPROACH_POINT, NO_CANDIDATE, GraspDetector, Prepared
from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.on_device.balls import ball_batch
from edgegrasp_model.on_device.hand_batch import hand_batch, hand_widths
from edgegrasp_model.on_device.precision import Precision
from edgegrasp_model.on_device.preparation import DeviceSample, sample_candidates
from edgegrasp_model.on_device.scene import DeviceScene, build_scene
from edgegrasp_model.on_device.scoring import ScoringNetwork
from edgegrasp_model.on_device.selection import select
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.preparation import Round
from edgegrasp_model.results import Detection

Float32 = NDArray[np.float32]


@dataclass
class DevicePrepared(Prepared):
    """A request between the stages, what it is about on a device."""

    device_scene: DeviceScene | None = None
    device_sample: DeviceSample | None = None


@dataclass(frozen=True)
class _DrawnOnDevice:
    rounds: list[Round]
    row: NDArray[np.int64]


class DeviceDetector(GraspDetector):
    """Detects grasps as `GraspDetector` does, with the same results, on a GPU or any device.

    Grasps that a caller gives (`score`) are prepared on the processor; only the network's share of
    them is the device's.
    """

    def __init__(
        self,
        network: nn.Module,
        metadata: CheckpointMetadata,
        gripper: Gripper,
        device: torch.device | str = "cpu",
        grippers: Mapping[str, Gripper] | None = None,
        precision: Precision = "float32",
    ) -> None:
        """Wrap a network.

        Args:
            network: Scores the candidates.
            metadata: What its weights were trained for.
            gripper: The one it was trained for, used where a request names none.
            device: Where everything runs.
            grippers: A user's own that requests may name, beside those that ship.
            precision: As for `ScoringNetwork`.
        """
        super().__init__(network, metadata, gripper, device, grippers)
        self._scoring = ScoringNetwork(self.network, precision)

    def prepare(self, cloud: object, options: DetectOptions) -> DevicePrepared:
        """First stage: everything before the network."""
        with torch.inference_mode():
            return self._prepare(cloud, options)

    def run(self, batch: BallBatch | HandBatch) -> Float32:
        """Second stage: the network's logits.  # (E,)."""
        with torch.inference_mode():
            logits: Float32 = self._scoring(batch.to(self.device)).cpu().numpy()
        return logits

    def finish(self, prepared: Prepared, logits: NDArray[np.floating]) -> Detection:
        """Last stage: scores, ranking, suppression, poses."""
        assert isinstance(prepared, DevicePrepared)
        with torch.inference_mode():
            return self._finish(prepared, logits)

    def _prepare(self, cloud: object, options: DetectOptions) -> DevicePrepared:
        sent = check_cloud(cloud, options.num_approach_points)
        prepared = DevicePrepared(**vars(self._begun(sent, options)))
        counts, gripper = prepared.counts, prepared.gripper
        with prepared.timed("cloud"):
            scene = build_scene(
                sent,
                options,
                self.metadata.voxel_size,
                counts,
                prepared.warnings,
                self.device,
            )
        prepared.device_scene = scene
        if scene is None:
            prepared.warn_of_few_points()
            return prepared
        if counts["in_approach_region"] == 0:
            prepared.warnings.append(NO_APPROACH_POINT)
            return prepared
        with prepared.timed("candidates"):
            radius, centre = prepared.crop_radius, self.sees_hands
            sample = sample_candidates(scene, options, gripper, radius, counts, centre)
        prepared.device_sample = sample
        if len(sample.candidates) == 0:
            prepared.warnings.append(NO_CANDIDATE)
            return prepared
        with prepared.timed("description"):
            self._describe(prepared, scene, sample)
        return prepared

    def _describe(self, prepared: DevicePrepared, scene: DeviceScene, sample: DeviceSample) -> None:
        network, gripper, candidates = self.metadata.network, prepared.gripper, sample.candidates
        if self.sees_hands:
            balls = len(sample.approach_index)
            width, prepared.batch = hand_batch(
                scene, candidates, balls, gripper, network.hand_points
            )
        else:
            width = hand_widths(scene, candidates, gripper)
            prepared.batch = ball_batch(
                scene.cloud, sample.approach_index, sample.crop, candidates, network.k
            )
        prepared.width = width.cpu().numpy()

    def _finish(self, prepared: DevicePrepared, logits: NDArray[np.floating]) -> Detection:
        scene, sample, width = prepared.device_scene, prepared.device_sample, prepared.width
        counts, options, gripper = prepared.counts, prepared.options, prepared.gripper
        grasps, debug = [], None
        with prepared.timed("ranking"):
            score, outcome = self._probability(logits), np.empty(0, dtype=np.int8)
            if scene is not None and sample is not None and width is not None:
                chosen = select(scene, sample, score, gripper, options, counts)
                rows, outcome = chosen.rows, chosen.outcome
                grasps = grasps_in_cloud(
                    scene.on_processor,
                    chosen.candidates.take(rows),
                    gripper,
                    score[rows],
                    width[rows],
                    sample.collision_free[rows],
                    chosen.clearance,
                )
            if options.debug and scene is not None:
                debug = debug_info(scene.on_processor, _drawn(sample), score, outcome)
        counts["returned"] = len(grasps)
        seconds, name = prepared.total_seconds(), self.metadata.name
        return Detection(grasps, counts, seconds, name, prepared.warnings, debug)


def _drawn(sample: DeviceSample | None) -> Drawn | None:
    if sample is None:
        return None
    return _DrawnOnDevice([each.on_processor for each in sample.rounds], sample.row)
