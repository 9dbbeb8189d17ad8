"""The pipeline: a point cloud in, ranked grasps out."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from edgegrasp_model.assembly import debug_info, grasps_in_cloud
from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.checkpoint import CheckpointMetadata, load_checkpoint
from edgegrasp_model.cloud_input import CheckedCloud, check_cloud
from edgegrasp_model.collision import clearances, widths_needed
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.evaluation import Scorer, evaluate, hand_batch
from edgegrasp_model.given_grasps import check_edges, check_hand_poses, from_edges, from_hand_poses
from edgegrasp_model.gripper import Gripper, load_gripper
from edgegrasp_model.gripper_choice import chosen_gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.preparation import Sample, sample_candidates
from edgegrasp_model.results import Detection, Evaluation, NoGrasp, Scoring
from edgegrasp_model.scene import Scene, build_scene
from edgegrasp_model.selection import select

Float32 = NDArray[np.float32]
Batch = BallBatch | HandBatch

NO_APPROACH_POINT = (
    "the approach region holds no point of the processed cloud. Rows hold a voxel by "
    "half of its points: around a single point, send a sphere."
)
NO_CANDIDATE = "no candidate satisfies every constraint; see counts."


@dataclass
class Prepared:
    """A request between the stages: what to score, and what to make of the scores."""

    options: DetectOptions
    gripper: Gripper
    crop_radius: float  # metres
    scene: Scene | None = None
    sample: Sample | None = None
    width: Float32 | None = None  # (E,) metres
    batch: Batch | None = None  # None where there is nothing to score
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Record the seconds spent inside as those of a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = time.perf_counter() - start

    def warn_of_few_points(self) -> None:
        """Say that too few points are left for a scene."""
        self.warnings.append(
            f"only {self.counts['kept']} points are left after cropping and cleaning."
        )

    def total_seconds(self) -> dict[str, float]:
        """Seconds of each stage and of all."""
        return self.seconds | {"total": sum(self.seconds.values())}


class GraspDetector:
    """Detects grasps with one network; holds no state between requests."""

    def __init__(
        self,
        network: nn.Module,
        metadata: CheckpointMetadata,
        gripper: Gripper,
        device: torch.device | str = "cpu",
        grippers: Mapping[str, Gripper] | None = None,
    ) -> None:
        """Wrap a network.

        Args:
            network: Scores the candidates.
            metadata: What its weights were trained for.
            gripper: The one it was trained for, used where a request names none.
            device: Where it runs.
            grippers: A user's own that requests may name, beside those that ship.
        """
        self.network = network.to(device).eval()
        self.metadata = metadata
        self.gripper = gripper
        self.device = torch.device(device)
        self.grippers = dict(grippers or {})

    @classmethod
    def load(
        cls,
        path: Path,
        device: torch.device | str = "cpu",
        grippers: Mapping[str, Gripper] | None = None,
    ) -> "GraspDetector":
        """Load a checkpoint and the gripper it was trained for.

        Args:
            path: The file.
            device: The processor, or a GPU: there the whole pipeline runs, in `on_device`.
                Weights in int8 stay on the processor.
            grippers: A user's own that requests may name, beside those that ship.

        Raises:
            InvalidCheckpoint: The file cannot be used.
            InvalidGripper: Its gripper is not known here.
        """
        network, metadata = load_checkpoint(path)
        if metadata.network.architecture == "edgegrasp-int8":
            device = "cpu"  # its layers are there for the processor only
        kind: type[GraspDetector] = cls
        if torch.device(device).type != "cpu":
            from edgegrasp_model.on_device.detector import DeviceDetector  # it imports this file

            kind = DeviceDetector
        return kind(network, metadata, load_gripper(metadata.gripper), device, grippers)

    def detect(self, cloud: object, options: DetectOptions | None = None) -> Detection:
        """Detect grasps in a cloud.

        Args:
            cloud: (N, 3) float32 or float64 array, or (H, W, 3) with NaN holes, metres; or a
                CloudInput. Its frame is the frame of the options and of the result.
            options: What to ask for; the defaults where omitted.

        Returns:
            Ranked grasps. None found is an answer too: the counts and warnings say why.

        Raises:
            InvalidRequest: The cloud or an option cannot be used; names field, value and fix.
        """
        prepared = self.prepare(cloud, options or DetectOptions())
        with prepared.timed("network"):
            logits = self.run(prepared.batch) if prepared.batch is not None else np.empty(0)
        return self.finish(prepared, logits)

    def prepare(
        self, cloud: object, options: DetectOptions, max_voxels: int | None = None
    ) -> Prepared:
        """First stage: everything before the network, on the processor.

        Args:
            cloud: As for `detect`.
            options: As for `detect`.
            max_voxels: Most voxels that the cloud may fill; None: any number.
        """
        sent = check_cloud(cloud, options.num_approach_points)
        prepared = self._with_scene(sent, options, max_voxels)
        scene, gripper = prepared.scene, prepared.gripper
        if scene is None:
            return prepared
        if not scene.approach_allowed.any():
            prepared.warnings.append(NO_APPROACH_POINT)
            return prepared
        with prepared.timed("candidates"):
            radius, counts = prepared.crop_radius, prepared.counts
            sample = sample_candidates(scene, options, gripper, radius, counts, self.sees_hands)
        prepared.sample = sample
        if len(sample.candidates) == 0:
            prepared.warnings.append(NO_CANDIDATE)
            return prepared
        with prepared.timed("description"):
            prepared.width = widths_needed(sample.view, gripper)
            prepared.batch = self._batch(scene, sample, gripper)
        return prepared

    def run(self, batch: Batch) -> Float32:
        """Second stage: the network's logits.  # (E,)."""
        with torch.inference_mode():
            logits: Float32 = self.network(batch.to(self.device)).float().cpu().numpy()
        return logits

    def finish(self, prepared: Prepared, logits: NDArray[np.floating]) -> Detection:
        """Last stage: scores, ranking, suppression, poses."""
        scene, sample, width = prepared.scene, prepared.sample, prepared.width
        counts, options, gripper = prepared.counts, prepared.options, prepared.gripper
        grasps, debug = [], None
        with prepared.timed("ranking"):
            score, outcome = self._probability(logits), np.empty(0, dtype=np.int8)
            if scene is not None and sample is not None and width is not None:
                rows, outcome = select(scene, sample, score, gripper, options, counts)
                best, free = sample.candidates.take(rows), sample.collision_free[rows]
                clear = clearances(scene, best.T_cloud_hand, gripper)
                grasps = grasps_in_cloud(
                    scene, best, gripper, score[rows], width[rows], free, clear
                )
            if options.debug and scene is not None:
                debug = debug_info(scene, sample, score, outcome)
        counts["returned"] = len(grasps)
        seconds, name = prepared.total_seconds(), self.metadata.name
        return Detection(grasps, counts, seconds, name, prepared.warnings, debug)

    def score(
        self,
        cloud: object,
        options: DetectOptions | None = None,
        *,
        edges: object | None = None,
        hand_poses: object | None = None,
        max_voxels: int | None = None,
    ) -> Scoring:
        """Score edges or hand poses of the caller's (the paper's grasp evaluation function).

        Options say what the scene is, which hand it is and what it must not meet. Regions,
        directions and what concerns sampling and selection have no effect. The hand of an edge
        that would cut into the support plane is drawn back where that helps, as in `detect`;
        given hand poses stay.

        Args:
            cloud: As for `detect`.
            options: As for `detect`.
            edges: (M, 2) integers: rows of the cloud as sent, approach and contact point. They
                stand for the points of the processed cloud that they went into.
            hand_poses: (M, 4, 4) T_cloud_hand. Exactly one of the two is given.
            max_voxels: As for `prepare`.

        Returns:
            One evaluation for each edge or pose, in order.

        Raises:
            InvalidRequest: The cloud, an option, the edges or the poses cannot be used.
        """
        if (edges is None) == (hand_poses is None):
            value = "neither edges nor hand_poses" if edges is None else "edges and hand_poses"
            raise InvalidRequest("edges", value, "Send one of the two.")
        sent, options = check_cloud(cloud), options or DetectOptions()
        asked: NDArray[Any] = (
            check_hand_poses(hand_poses) if edges is None else check_edges(edges, sent.rows_sent)
        )
        no_region = {"approach_region": None, "contact_region": None}
        prepared = self._with_scene(sent, options.model_copy(update=no_region), max_voxels)
        evaluations = [Evaluation(None, NoGrasp.NO_POINT)] * len(asked)
        if prepared.scene is not None:
            scene, gripper = prepared.scene, prepared.gripper
            scorer = Scorer(
                lambda batch: self._probability(self.run(batch)),
                prepared.crop_radius,
                self.metadata.network,
            )
            with prepared.timed("candidates"):
                if edges is None:
                    poses = scene.frame.poses(asked)
                    given = from_hand_poses(scene, poses, gripper, scorer.crop_radius)
                else:
                    margin = options.collision.margin
                    given = from_edges(scene, asked, gripper, scorer.crop_radius, margin)
            with prepared.timed("network"):
                evaluations = evaluate(scene, given, gripper, options.collision, scorer)
        prepared.counts["given"] = len(asked)
        prepared.counts["scored"] = sum(each.grasp is not None for each in evaluations)
        seconds, name = prepared.total_seconds(), self.metadata.name
        return Scoring(evaluations, prepared.counts, seconds, name, prepared.warnings)

    def _with_scene(
        self, sent: CheckedCloud, options: DetectOptions, max_voxels: int | None
    ) -> Prepared:
        """Choose the gripper and build the scene, where enough of the cloud is left."""
        prepared = self._begun(sent, options)
        with prepared.timed("cloud"):
            prepared.scene = build_scene(
                sent,
                options,
                self.metadata.voxel_size,
                prepared.counts,
                prepared.warnings,
                max_voxels,
            )
        if prepared.scene is None:
            prepared.warn_of_few_points()
        return prepared

    def _begun(self, sent: CheckedCloud, options: DetectOptions) -> Prepared:
        """Choose the gripper and the balls, and warn of what is not known."""
        gripper = chosen_gripper(options, self.gripper, self.grippers)
        radius = self.metadata.crop_radius
        if options.gripper is not None:  # the ball has to hold every contact within reach
            radius = max(radius, gripper.max_opening / 2)
        prepared = Prepared(options, gripper, radius)
        if gripper.name != self.gripper.name:
            prepared.warnings.append(
                f"the weights were trained for the gripper {self.gripper.name!r}: for "
                f"{gripper.name!r} their scores rank grasps, but promise less."
            )
        if options.viewpoint is None and sent.normals is None:
            prepared.warnings.append(
                "viewpoint is not given: normals are turned upward; send the camera's position."
            )
        return prepared

    def _probability(self, logits: NDArray[np.floating]) -> NDArray[np.float64]:
        """Calibrated probabilities (E,) of logits (E,)."""
        scaled = logits.astype(np.float64) / self.metadata.temperature
        probability: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-scaled))
        return probability

    @property
    def sees_hands(self) -> bool:
        """Whether scores are of hands where they are, not of edges wherever their hands are."""
        return self.metadata.network.architecture == "hand"

    def _batch(self, scene: Scene, sample: Sample, gripper: Gripper) -> Batch:
        candidates, network = sample.candidates, self.metadata.network
        if self.sees_hands:
            return hand_batch(scene, candidates, gripper, network, sample.view)
        return BallBatch.from_cloud(
            scene.cloud.points,
            scene.cloud.normals,
            sample.approach_index,
            sample.crop,
            candidates.pair,
            candidates.approach,
            candidates.depth,
            network.k,
        )
