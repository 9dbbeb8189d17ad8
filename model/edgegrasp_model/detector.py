"""The pipeline: a point cloud in, ranked grasps out."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.checkpoint import CheckpointMetadata, load_checkpoint
from edgegrasp_model.cloud import Cloud, validate_cloud
from edgegrasp_model.collision import widths_needed
from edgegrasp_model.gripper import Gripper, load_gripper
from edgegrasp_model.hand_description import describe_hands
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.preparation import Sample, clean_cloud, sample_candidates
from edgegrasp_model.ranking import ranked, suppress
from edgegrasp_model.results import Detection, Grasp

Float32 = NDArray[np.float32]


@dataclass
class Prepared:
    """A request between the stages: what to score, and what to make of the scores."""

    options: DetectOptions
    cloud: Cloud | None = None
    sample: Sample | None = None
    width: Float32 | None = None  # (E,) metres
    batch: BallBatch | None = None  # None where there is nothing to score
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Record the seconds spent inside as those of a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = time.perf_counter() - start


class GraspDetector:
    """Detects grasps with one network and one gripper; holds no state between requests."""

    def __init__(
        self,
        network: nn.Module,
        metadata: CheckpointMetadata,
        gripper: Gripper,
        device: torch.device | str = "cpu",
    ) -> None:
        self.network = network.to(device).eval()
        self.metadata = metadata
        self.gripper = gripper
        self.device = device

    @classmethod
    def load(cls, path: Path, device: torch.device | str = "cpu") -> Self:
        """Load a checkpoint and the gripper it was trained for.

        Raises:
            InvalidCheckpoint: The file cannot be used.
            InvalidGripper: Its gripper is not known here.
        """
        network, metadata = load_checkpoint(path, device)
        return cls(network, metadata, load_gripper(metadata.gripper), device)

    def detect(self, cloud: object, options: DetectOptions | None = None) -> Detection:
        """Detect grasps in a cloud.

        Args:
            cloud: (N, 3) float32 or float64 array, metres; its frame is the frame of the result.
            options: What to ask for; the defaults where omitted.

        Returns:
            Ranked grasps. None found is an answer too: the counts and warnings say why.

        Raises:
            InvalidRequest: The cloud cannot be used; names field, value and fix.
        """
        prepared = self.prepare(cloud, options or DetectOptions())
        with prepared.timed("network"):
            logits = self.run(prepared.batch) if prepared.batch is not None else np.empty(0)
        return self.finish(prepared, logits)

    def prepare(self, cloud: object, options: DetectOptions) -> Prepared:
        """First stage: everything before the network, on the processor."""
        points = validate_cloud(cloud, options.num_approach_points)
        prepared = Prepared(options)
        if options.viewpoint is None:
            prepared.warnings.append(
                "viewpoint is not given: normals are turned upward; send the camera's position."
            )
        with prepared.timed("cloud"):
            clean = clean_cloud(points, options, self.metadata.voxel_size, prepared.counts)
        if clean is None:
            prepared.warnings.append(
                f"only {prepared.counts['kept']} points are left after cropping and cleaning."
            )
            return prepared
        with prepared.timed("candidates"):
            sample = sample_candidates(
                clean,
                options,
                self.gripper,
                self.metadata.crop_radius,
                self.metadata.k,
                prepared.counts,
            )
        prepared.cloud, prepared.sample = clean, sample
        if len(sample.candidates) == 0:
            prepared.warnings.append("no candidate satisfies every constraint; see counts.")
            return prepared
        with prepared.timed("description"):
            prepared.width = widths_needed(sample.view, self.gripper)
            prepared.batch = self._batch(clean, sample, options)
        return prepared

    def run(self, batch: BallBatch) -> Float32:
        """Second stage: the network's logits.  # (E,)."""
        with torch.inference_mode():
            logits: Float32 = self.network(batch.to(self.device)).float().cpu().numpy()
        return logits

    def finish(self, prepared: Prepared, logits: NDArray[np.floating]) -> Detection:
        """Last stage: scores, ranking, suppression, poses."""
        with prepared.timed("ranking"):
            grasps = self._ranked_grasps(prepared, logits) if len(logits) else []
        prepared.counts["returned"] = len(grasps)
        seconds = prepared.seconds | {"total": sum(prepared.seconds.values())}
        return Detection(grasps, prepared.counts, seconds, self.metadata.name, prepared.warnings)

    def _batch(self, cloud: Cloud, sample: Sample, options: DetectOptions) -> BallBatch:
        candidates, description = sample.candidates, None
        if self.metadata.network.hand_description_size:
            up = np.asarray(options.up, dtype=np.float32)
            description = describe_hands(
                cloud, candidates, self.gripper, up, options.support, sample.view
            )
        return BallBatch.from_cloud(
            cloud.points,
            cloud.normals,
            sample.approach_index,
            sample.crop,
            candidates.pair,
            candidates.approach,
            candidates.depth,
            description,
        )

    def _ranked_grasps(self, prepared: Prepared, logits: NDArray[np.floating]) -> list[Grasp]:
        sample, cloud, width = prepared.sample, prepared.cloud, prepared.width
        assert sample is not None
        assert cloud is not None
        assert width is not None
        options, counts = prepared.options, prepared.counts
        score = 1.0 / (1.0 + np.exp(-logits.astype(np.float64) / self.metadata.temperature))
        order = ranked(score, sample.collision_free)
        order = order[score[order] >= options.min_score]
        counts["above_min_score"] = len(order)
        T_cloud_hand = sample.candidates.T_cloud_hand
        T_cloud_tcp = T_cloud_hand @ self.gripper.T_hand_tcp
        if options.suppression is not None:
            order = suppress(T_cloud_tcp, order, options.suppression, options.top_k)
        order = order[: options.top_k]
        candidates = sample.candidates
        return [
            Grasp(
                score=float(np.float32(score[row])),
                T_cloud_hand=T_cloud_hand[row],
                T_cloud_tcp=T_cloud_tcp[row],
                width=float(width[row]),
                approach_point=cloud.points[candidates.approach_index[row]],
                contact_point=cloud.points[candidates.contact_index[row]],
                approach_direction=T_cloud_hand[row, :3, 2],
                collision_free=bool(sample.collision_free[row]),
                clearance=0.0,
            )
            for row in order
        ]
