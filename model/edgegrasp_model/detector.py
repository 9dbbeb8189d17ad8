"""The pipeline: a point cloud in, ranked grasps out; and the catalogue of detectors by name."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from scipy.special import expit, logit
from torch import nn

from edgegrasp_camera.arrays import Array, Float32, Floats, Int64
from edgegrasp_model import ranking, tracking
from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.candidates.edge_grasps import Candidates
from edgegrasp_model.candidates.sample import Sample, Sampler
from edgegrasp_model.errors import InvalidCheckpoint, InvalidDevice, InvalidRequest, UnknownModel
from edgegrasp_model.given import Given, check_edges, check_hand_poses, from_edges, from_hand_poses
from edgegrasp_model.gripper import Gripper, choose_gripper, load_gripper
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import check_reference_logits, load_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.options import Collision, DetectOptions
from edgegrasp_model.results import NoGraspReason, UnitCosts
from edgegrasp_model.scene.cloud import HAND_REACH, assumed_viewpoint, check_cloud
from edgegrasp_model.scene.scene import (
    MAX_VOXELS,
    NO_OBJECT,
    Scene,
    SelectedPoints,
    build_scene,
    select_points,
)
from edgegrasp_results import Detection, Evaluation, FoundSupport, GripperOutline, Scoring

NO_APPROACH_POINT = (
    "the approach region contains no point of the processed cloud. Rows contain a voxel if they "
    "list at least half of its points; to select around a single point, send a sphere."
)
NO_CANDIDATE = "no candidate satisfies every constraint; see counts."
# In each round, an object with a grasp rated this high gets no further approach points.
ENOUGH_SCORES = (1.0, ranking.SURE_SCORE, ranking.GOOD_SCORE, ranking.GOOD_SCORE)
MAX_BALLS_AT_ONCE = 64
MIN_TRAINING_HANDS = 20  # weights last trained with at least this many grippers suit any gripper
WEIGHTS_FOLDER = Path(__file__).parent / "weights"
PREFERRED_MODELS = ("edgegrasp-plus", "edgegrasp", "edgegrasp-small", "vn-edgegrasp")


@dataclass(frozen=True)
class Prepared:
    """A request and its scene; each stage adds counts, warnings and seconds."""

    options: DetectOptions
    gripper: Gripper
    crop_radius: float  # metres
    selected: SelectedPoints
    scene: Scene | None  # None if too few points are left
    counts: defaultdict[str, int]
    warnings: list[str]
    seconds: dict[str, float]
    followed: tracking.Followed | None = None  # objects followed from an earlier answer

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent in the block to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


class GraspDetector:
    """Detects grasps with one network; keeps no state between requests."""

    def __init__(
        self,
        network: nn.Module,  # scores the candidates
        metadata: CheckpointMetadata,  # of the weights
        device: torch.device | str = "cpu",  # where the network runs
        grippers: Mapping[str, Gripper] | None = None,  # the user's own, by name
    ) -> None:
        """Load the gripper that the weights were trained for; raises InvalidGripper."""
        self.network = network.to(device).eval()
        self.metadata = metadata
        # Whether the network scores the hand pose itself rather than the edge.
        self.sees_hands = metadata.network.architecture == "hand"
        self.gripper = load_gripper(metadata.gripper)  # used if a request names none
        self.device = torch.device(device)
        self.grippers = dict(grippers or {})

    @classmethod
    def load(
        cls,
        path: Path,
        device: torch.device | str = "cpu",
        grippers: Mapping[str, Gripper] | None = None,
    ) -> "GraspDetector":
        """Load a checkpoint and its gripper; raises InvalidCheckpoint or InvalidGripper."""
        return cls(*load_checkpoint(path), device, grippers)

    def detect(self, cloud: object, options: DetectOptions | None = None) -> Detection:
        """Detect grasps in a cloud; if there are none, counts and warnings of the answer say why.

        The cloud, metres, is (N, 3), or (H, W, 3) with NaN holes, or a CloudInput; options and
        result are in its frame. InvalidRequest names a field, its value and the fix.
        """
        prepared = self.prepare(cloud, options or DetectOptions())
        return self.finish(prepared, self.evaluate(prepared))

    def prepare(
        self,
        cloud: object,
        options: DetectOptions,
        max_voxels: int = MAX_VOXELS,  # most voxels that the cloud may have
        *,
        thin: bool = True,  # leave out rows and columns of large images
    ) -> Prepared:
        """First stage: choose the gripper, and build the scene if enough of the cloud is left."""
        start = time.perf_counter()
        sent = check_cloud(cloud, options.num_approach_points or 1, thin)
        counts: defaultdict[str, int] = defaultdict(int)
        gripper, warnings = choose_gripper(options, self.gripper, self.grippers), [*sent.warnings]
        radius = self.metadata.network.crop_radius
        if options.gripper is not None:  # the ball has to contain every contact within reach
            radius = max(radius, gripper.max_opening / 2)
        hands = self.metadata.training.get("training_hands", 1)
        if gripper.name != self.gripper.name and hands < MIN_TRAINING_HANDS:
            warnings.append(
                f"the weights were trained for the gripper {self.gripper.name!r}: their scores are "
                f"uncalibrated for {gripper.name!r}; use them for ranking only."
            )
        if options.viewpoint is None:
            eye = getattr(cloud, "viewpoint", None)  # of a CloudInput
            eye = assumed_viewpoint(sent, options, warnings) if eye is None else eye
            options = options.model_copy(update={"viewpoint": eye})
        previous, followed, choice = options.previous, None, options.objects
        if previous is not None:
            options = tracking.narrowed(options, gripper.name, sent.points)
        rules, counts["points"] = options.collision, len(sent.points)
        moved = max(rules.approach_length, rules.retreat_length) + rules.margin
        further = max(gripper.reach + moved - HAND_REACH, 0.0)
        selected = select_points(sent, options, further, counts, warnings)
        scene = build_scene(selected, options, self.metadata.voxel_size, counts, max_voxels)
        if scene is None:
            warnings.append(
                "after removing the support plane, background and outliers, "
                f"{counts['kept']} points remain: too few for a surface; see counts."
            )
        elif previous is not None:
            chosen, given = bool(options.at or options.near), sent.segment_ids is not None
            scene, followed = tracking.follow(scene, previous, given, chosen)
            if options.debug:
                labels = tracking.relabelled(selected, scene, followed, previous.search)
                selected = replace(selected, labels=labels)
            if previous.search:
                scene, followed = tracking.only_chosen(scene, followed, choice, warnings)
        seconds = {"cloud": time.perf_counter() - start}
        return Prepared(
            options, gripper, radius, selected, scene, counts, warnings, seconds, followed
        )

    def evaluate(self, prepared: Prepared) -> Sample | None:
        """Second stage: sample candidates and score them; None if there is no scene.

        Round 1 uses half of the approach points, round 2 the other half on objects without a sure
        grasp; rounds 3 and 4, a last resort, use more points on objects without a good grasp.
        """
        scene, scored = prepared.scene, None
        if scene is None or not scene.approach_allowed.any() or prepared.options.follows_only:
            return None
        given = prepared.options, prepared.gripper, prepared.crop_radius, prepared.counts
        sampler = Sampler(scene, *given, sees_hands=self.sees_hands)
        for enough in ENOUGH_SCORES:
            with prepared.timed("candidates"):
                done: Int64 | tuple[()] = ()
                if scored is not None:
                    held = expit(scored.logits) >= enough
                    if prepared.options.collision.mode != "ignore":
                        held &= scored.collision_free
                    done = scene.object_of_point[scored.candidates.approach_index[held]]
                sample = sampler.sample(done, last_resort=enough == ranking.GOOD_SCORE)
            if sample is None:
                continue
            logits = self._logits(prepared, scene, sample.candidates) / self.metadata.temperature
            sample = sample.scored(logits.astype(np.float32))
            scored = sample if scored is None else scored.followed_by(sample)
        return scored

    def finish(self, prepared: Prepared, sample: Sample | None) -> Detection:
        """Last stage: scores, ranking, suppression, poses."""
        scene, gripper, options = prepared.scene, prepared.gripper, prepared.options
        counts, grasps, debug = prepared.counts, [], None
        with prepared.timed("ranking"):
            score: Floats = np.empty(0, dtype=np.float32)
            outcome = np.empty(0, dtype=np.int8)
            if scene is not None and not scene.approach_allowed.any():
                why = NO_APPROACH_POINT if options.approach_region else NO_OBJECT
                prepared.warnings.append(why)
            elif sample is not None and len(sample.logits) == 0:
                prepared.warnings.append(NO_CANDIDATE)
            elif scene is not None and sample is not None:
                logits = sample.logits
                if self.sees_hands:
                    logits = ranking.average_similar_hands(sample, scene, gripper)
                contact = sample.candidates.contact_index
                rating, score = self._scores(scene, contact, expit(logits))
                rows, outcome = ranking.select(
                    scene, sample, score, rating, gripper, options, counts
                )
                best, free = sample.candidates.take(rows), sample.collision_free[rows]
                grasps = ranking.grasps_in_cloud(scene, best, gripper, score[rows], free)
            if options.debug and scene is not None:
                debug = ranking.debug_info(scene, sample, score, outcome, prepared.selected.labels)
        tracked = None if options.previous is None else tracking.untracked(options.previous)
        objects = []
        if scene is not None:
            if prepared.followed is not None:
                score_poses = partial(self._score_poses, prepared, scene)
                context = options, scene, gripper, score_poses
                grasps, tracked = tracking.merged(grasps, prepared.followed, *context)
            with prepared.timed("ranking"):
                objects = ranking.detected_objects(scene, grasps, sample, score, gripper)
            if prepared.followed is not None:
                surface = prepared.followed.surface
                objects = [replace(one, surface=surface.get(one.number)) for one in objects]
        counts["returned"], plane = len(grasps), None
        if (support := prepared.selected.support) is not None:
            *normal, height = support.frame.T_canonical_cloud[2].tolist()  # of the cloud's origin
            unit = np.array(normal, dtype=np.float32)
            plane = FoundSupport(unit, -height, support.residual, support.share)
        return Detection(
            grasps,
            dict(counts),
            prepared.seconds | {"total": sum(prepared.seconds.values())},
            self.metadata.name,
            GripperOutline(gripper.name, gripper.palm_z, gripper.tip_z),
            prepared.warnings,
            debug,
            plane,
            prepared.selected.up.astype(np.float32),
            objects,
            tracked,
        )

    def score(
        self,
        cloud: object,  # as for `detect`, like the options
        options: DetectOptions | None = None,
        *,
        edges: object | None = None,  # (M, 2) rows of the cloud as sent: approach and contact point
        hand_poses: object | None = None,  # (M, 4, 4) T_cloud_hand; one of the two is given
        max_voxels: int = MAX_VOXELS,  # most voxels that the cloud may have
    ) -> Scoring:
        """Score the caller's edges or hand poses, in order (the paper's grasp evaluation function).

        Approach directions, and options on sampling and selection, have no effect; regions only
        mark an object that is not recognised. The hand of an edge that would cut into the support
        is retracted where that helps; given poses stay as they are.
        """
        if edges is not None and hand_poses is not None:
            raise InvalidRequest("hand_poses", "poses beside edges", "Send one of the two.")
        options = options or DetectOptions()
        unused = dict.fromkeys(("num_approach_points", "previous"))
        options = options.model_copy(update=unused)
        prepared = self.prepare(cloud, options, max_voxels, thin=edges is None)
        rows = len(prepared.selected.labels)
        asked: Array = check_hand_poses(hand_poses) if edges is None else check_edges(edges, rows)
        evaluations = [Evaluation(None, NoGraspReason.NO_POINT)] * len(asked)
        if prepared.scene is not None:
            scene, gripper = prepared.scene, prepared.gripper
            if edges is None:
                evaluations = self._score_poses(prepared, scene, asked, options.collision)
            else:
                with prepared.timed("candidates"):
                    margin = options.collision.margin
                    given = from_edges(scene, asked, gripper, prepared.crop_radius, margin)
                evaluations = self._score_given(prepared, scene, given, options.collision)
        prepared.counts["given"] = len(asked)
        prepared.counts["scored"] = sum(each.grasp is not None for each in evaluations)
        counts, seconds = dict(prepared.counts), prepared.seconds
        seconds["total"] = sum(seconds.values())
        return Scoring(evaluations, counts, seconds, self.metadata.name, prepared.warnings)

    def _score_poses(
        self, prepared: Prepared, scene: Scene, T_cloud_hand: Float32, request: Collision
    ) -> list[Evaluation]:
        """An evaluation of each hand pose (M, 4, 4)."""
        with prepared.timed("candidates"):
            poses = scene.frame.poses_from_cloud(T_cloud_hand)
            given = from_hand_poses(scene, poses, prepared.gripper, prepared.crop_radius)
        return self._score_given(prepared, scene, given, request)

    def _score_given(
        self, prepared: Prepared, scene: Scene, given: Given, request: Collision
    ) -> list[Evaluation]:
        """An evaluation of each given edge or hand pose, in order."""
        candidates, gripper = given.candidates, prepared.gripper
        logits = self._logits(prepared, scene, candidates).astype(np.float64)
        if given.T_cloud_hand is not None:
            candidates = replace(candidates, T_cloud_hand=given.T_cloud_hand)
        with prepared.timed("network"):
            held = expit(logits / self.metadata.temperature)
            _, score = self._scores(scene, candidates.contact_index, held)
            hands = candidates.T_cloud_hand, candidates.opening
            free = ~collides(scene, *hands, gripper, request)
            grasps = ranking.grasps_in_cloud(scene, candidates, gripper, score, free)
        evaluations = [Evaluation(None, reason) for reason in given.reason]
        for number, grasp in zip(candidates.pair.tolist(), grasps, strict=True):
            evaluations[number] = Evaluation(grasp, None)
        return evaluations

    def _scores(self, scene: Scene, contact: Int64, held: Floats) -> tuple[Floats, Floats]:
        """Ratings and scores (E,), from the probability (E,) that each hand holds what is there.

        A rating also counts whether the object at the contact, row (E,) of the cloud, is real. A
        score is the rating rescaled by outcomes of a robot (Platt scaling), if there are any.
        """
        number = scene.object_of_point[contact].tolist()
        rating = held * np.array([scene.confidence.get(which, 1.0) for which in number])
        if (fitted := self.metadata.training.get("rescaled_by_outcomes")) is None:
            return rating, rating
        scale, shift = fitted
        return rating, expit(scale * logit(rating) + shift)

    def _logits(self, prepared: Prepared, scene: Scene, candidates: Candidates) -> Float32:
        """The network's logits (E,) of candidates: all hands at once, or a few balls at a time."""
        logits, network = np.empty(len(candidates), np.float32), self.metadata.network
        _, ball = np.unique(candidates.approach_index, return_inverse=True)
        part = np.zeros_like(ball) if self.sees_hands else ball // MAX_BALLS_AT_ONCE
        for number in range(part.max(initial=-1) + 1):
            rows = np.flatnonzero(part == number)
            with prepared.timed("description"):
                some = candidates.take(rows)
                batch: HandBatch | BallBatch
                if self.sees_hands:
                    sizes = network.hand_points, network.description_size
                    batch = HandBatch.from_hands(scene, some, prepared.gripper, *sizes)
                else:
                    batch = BallBatch.from_candidates(
                        scene.cloud, some, prepared.crop_radius, network.k
                    )
            exact = torch.autocast(self.device.type, enabled=False)  # even if the caller uses it
            with prepared.timed("network"), torch.inference_mode(), exact:
                logits[rows] = self.network(batch.to(self.device)).float().cpu().numpy()
        return logits


class ModelCatalogue:
    """Named detectors, one of them the default."""

    unit_costs = UnitCosts()  # the default detector's, on this machine, once warm

    def __init__(self, detectors: Mapping[str, GraspDetector], default: str = "") -> None:
        """Collect detectors by name, at least one; `default` as for `load`."""
        if not detectors:
            raise InvalidCheckpoint("weights: found none. Give a folder with .safetensors files.")
        self._detectors = dict(detectors)
        preferred = [name for name in PREFERRED_MODELS if name in detectors] or sorted(detectors)
        self.default = default or preferred[0]
        if self.default not in detectors:
            fix = f"Use one of: {', '.join(sorted(detectors))}."
            raise InvalidCheckpoint(f"default_model: got {default!r}. {fix}")

    @classmethod
    def load(
        cls,
        weights: Sequence[Path] = (),  # .safetensors files, or folders of them
        default: str = "",  # name to use if a request names none; empty: the best one loaded
        device: torch.device | str = "cpu",  # where the networks run
        grippers: Sequence[Path] = (),  # files that requests may name by their stem
    ) -> Self:
        """Load the shipped weights, then the user's own; each model has the name of its file.

        Raises:
            EdgeGraspError: A file cannot be used, or no weights have the default's name.
        """
        own = {file.stem: load_gripper(file) for file in grippers}
        files: dict[str, Path] = {}
        for source in (WEIGHTS_FOLDER, *weights):
            found = sorted(source.glob("*.safetensors")) if source.is_dir() else [source]
            if not any(map(Path.is_file, found)):
                fix = "Give a .safetensors file, or a folder of them."
                raise InvalidCheckpoint(f"weights: got {source}, where there are none. {fix}")
            files |= {file.stem: file for file in found}
        detectors = {name: GraspDetector.load(file, device, own) for name, file in files.items()}
        return cls(detectors, default)

    def get(self, name: str = "") -> GraspDetector:
        """The detector of that name, or the default for an empty name; raises UnknownModel."""
        if (name := name or self.default) not in self._detectors:
            raise UnknownModel(name, self._detectors)
        return self._detectors[name]

    def describe(self) -> list[dict[str, Any]]:
        """A description of each model, as plain JSON values."""
        return [
            {
                "name": name,
                "default": name == self.default,
                "architecture": detector.metadata.network.architecture,
                "parameters": sum(p.numel() for p in detector.network.parameters()),
                "digest": detector.metadata.digest,
                "crop_radius": detector.metadata.network.crop_radius,
                "voxel_size": detector.metadata.voxel_size,
                "gripper": detector.metadata.gripper,
                "hand_description": detector.sees_hands,
                "device": str(detector.device),
            }
            for name, detector in sorted(self._detectors.items())
        ]

    def warm_up(self) -> None:
        """Detect once with the default model, so that the first request is not slow.

        InvalidCheckpoint: a network does not give the logits that it was written with.
        """
        rng = np.random.default_rng(0)
        box = rng.uniform(-1.0, 1.0, (2000, 3)) * (0.02, 0.03, 0.04)
        table = rng.uniform(-1.0, 1.0, (4000, 3)) * (0.3, 0.3, 0.001) - (0.0, 0.0, 0.04)
        # Without a viewpoint, so that the search for one is compiled too.
        options = DetectOptions(num_approach_points=4, num_candidates=100)
        for detector in self._detectors.values():
            check_reference_logits(detector.network, detector.metadata)
        cloud = np.concatenate([box, table])
        self.get().detect(cloud, options)  # also warms what the others share with it
        self.unit_costs = self._measure_unit_costs(rng)

    def _measure_unit_costs(self, rng: np.random.Generator) -> UnitCosts:
        """Detect in a small, a dense and a wide cloud; takes 0.2 s."""
        options = DetectOptions(
            viewpoint=(0.0, 0.0, 1.0), num_candidates=1, objects="off", support=None
        )
        seconds, voxels, sizes = [], [], (1_000, 200_000, 10_000)
        for size, side in zip(sizes, (0.02, 0.02, 1.5), strict=True):
            points = rng.uniform(-0.5, 0.5, (size, 3)) * (side, side, 0.001)
            start = time.process_time()  # unlike wall-clock time, it is the same on a busy machine
            counts = self.get().detect(points.astype(np.float32), options).counts
            seconds.append(time.process_time() - start)
            voxels.append(counts["voxels"])
        small, dense, wide = seconds
        point = max(dense - small, 0.0) / (sizes[1] - sizes[0])
        return UnitCosts(point, voxel=max(wide - small, 0.0) / (voxels[2] - voxels[0]))


def choose_device(name: str) -> torch.device:
    """The device of that name; `auto`: the first GPU, else the processor. Raises InvalidDevice."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    first = {"auto": "cuda:0", "cuda": "cuda:0"} if gpus else {"auto": "cpu"}
    known = {"cpu": "cpu", **first} | {here: here for here in map("cuda:{}".format, range(gpus))}
    if name not in known:
        sees = f"PyTorch {torch.__version__} sees {gpus} GPUs here"
        fix = f"Use auto, cpu, cuda, or cuda:N for one GPU of several; {sees}."
        raise InvalidDevice("device", repr(name), fix)
    return torch.device(known[name])
