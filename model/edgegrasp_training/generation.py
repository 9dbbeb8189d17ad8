"""Generate labelled views: observe random clutter, try edge grasps in it, keep what happened."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray

from edgegrasp_model.cloud_input import check_cloud
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import Collision, DetectOptions, SupportPlane, Workspace
from edgegrasp_model.preparation import Sample, sample_candidates
from edgegrasp_model.scene import Scene, build_scene
from edgegrasp_sim.camera import TRAINING_VIEWS
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.scene import PACKED_SCALE, PILE_SCALE
from edgegrasp_sim.simulation import ClutterSimulation, Observation
from edgegrasp_training.hollow_shapes import write_hollow_shapes
from edgegrasp_training.varied_objects import varied_objects
from edgegrasp_training.views import LabelledView

SCENE_STREAM, CAMERA_STREAM, NOISE_STREAM, CHOICE_STREAM, SHAPE_STREAM = 0, 1, 2, 3, 4
VOXEL_SIZE = 0.0045  # metres
SAMPLED_RADIUS = 0.04  # metres; balls that candidates are drawn from
APPROACH_POINTS = 12  # few balls with many tried grasps each cost the trainer least per label
MEAN_FURTHER_OBJECTS = 4  # a scene holds one object and Poisson(this) more
OTHER_OBJECTS = 0.3  # share of the scenes made of the other kind's objects: shapes of every sort
VARIED_SHARE = 0.7  # of the scenes of an object folder, made of stretched and hollow objects
WIDER_SCALES = 0.85, 1.15  # factors on both ends of the scales of a scene
BEST_SHARE = 0.1  # of the candidates, by score: what a network would have executed
UNSURE = 0.1, 0.8  # scores that leave the outcome open
SURE = 0.99  # score of a best grasp above which a view has little to teach
CLEARED_SHARE = 0.6  # of the scenes, rid first of the objects that a network is sure of
EASY_SHARE = 0.4  # of the grasps that are tried in a view whose best grasp is sure


@dataclass(frozen=True)
class GenerationOptions:
    """What to generate."""

    scenes: int = 100
    views_per_scene: int = 2
    grasps_per_view: int = 100
    free_share: float = 0.75  # of those chosen at random, hands the cloud says are free
    guided_share: float = 0.5  # of the tried grasps, where weights are given: best and unsure ones
    noise_std: float = 0.001  # metres
    seed: int = 1
    weights: Path | None = None  # of the network that guides the choice
    kind: SceneKind | None = None  # of all scenes; None: packed where the index is even, else piles

    def kind_of(self, index: int) -> SceneKind:
        """How a scene is made."""
        return self.kind or (SceneKind.PACKED if index % 2 == 0 else SceneKind.PILE)


def view_path(folder: Path, index: int, view: int, options: GenerationOptions) -> Path:
    """File of a view."""
    kind = options.kind_of(index).value
    return folder / f"{kind}_{options.seed}-{index:06d}_{view}.npz"


def missing_scenes(folder: Path, options: GenerationOptions) -> list[int]:
    """Indices of the scenes that lack a view."""
    return [
        index
        for index in range(options.scenes)
        if not all(
            view_path(folder, index, view, options).is_file()
            for view in range(options.views_per_scene)
        )
    ]


def generate(
    folder: Path, objects: Path | None, options: GenerationOptions, workers: int = 1
) -> Iterator[tuple[int, int, int]]:
    """Generate the scenes that are missing, in any order; the number of workers changes nothing.

    Args:
        folder: Gets one file per view.
        objects: Object sets in the layout `packed/train`, `pile/train`; None: the built-in ones.
        options: What to generate.
        workers: Processes.

    Yields:
        For each finished scene its index, the grasps tried in it and those that held.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = missing_scenes(folder, options)
    if workers == 1:
        for index in missing:
            yield index, *generate_scene(folder, objects, options, index)
        return
    with ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        futures = {
            pool.submit(generate_scene, folder, objects, options, index): index for index in missing
        }
        for future in as_completed(futures):
            yield futures[future], *future.result()


def generate_scene(
    folder: Path, objects: Path | None, options: GenerationOptions, index: int
) -> tuple[int, int]:
    """Generate all views of one scene; how many grasps were tried and how many held."""
    streams = [np.random.default_rng([options.seed, index, stream]) for stream in range(5)]
    kind = options.kind_of(index)
    source, scales = _variety(kind, streams[SCENE_STREAM])
    tried = held = 0
    with TemporaryDirectory() as shapes:
        drawn = None
        if objects is not None:
            drawn = _drawn_objects(objects, source, Path(shapes), streams[SHAPE_STREAM])
        with ClutterSimulation(None if drawn is None else {kind: drawn}) as simulation:
            count = 1 + int(streams[SCENE_STREAM].poisson(MEAN_FURTHER_OBJECTS))
            simulation.reset(kind, streams[SCENE_STREAM], count, scales)
            for number, view in enumerate(_views(simulation, options, streams)):
                view.save(view_path(folder, index, number, options))
                tried += len(view.tried())
                held += int((view.success == 1).sum())
    return tried, held


def _drawn_objects(
    objects: Path, source: SceneKind, folder: Path, rng: np.random.Generator
) -> ObjectSet:
    """The objects of a scene as they are, or varied ones, whose files the folder gets."""
    plain = ObjectSet.from_folder(objects, source, "train")
    if rng.random() >= VARIED_SHARE:
        return plain
    return varied_objects(plain, write_hollow_shapes(folder / "hollow"), folder, rng)


def _views(
    simulation: ClutterSimulation, options: GenerationOptions, streams: list[np.random.Generator]
) -> Iterator[LabelledView]:
    """Labelled views of the scene that stands in the simulation."""
    if options.weights is not None and streams[SCENE_STREAM].random() < CLEARED_SHARE:
        _clear_easy(simulation, _detector(options.weights), options.noise_std, streams)
    models = [model.origin or model for model in simulation.object_models]
    for _ in range(options.views_per_scene):
        observation = simulation.observe(
            streams[CAMERA_STREAM],
            streams[NOISE_STREAM],
            views=TRAINING_VIEWS,
            noise_std=options.noise_std,
        )
        yield replace(
            _label(simulation, observation, options, streams[CHOICE_STREAM]),
            objects=tuple(model.name for model in models),
            object_digests=tuple(model.digest for model in models),
        )


def _clear_easy(
    simulation: ClutterSimulation,
    guide: GraspDetector,
    noise_std: float,
    streams: list[np.random.Generator],
) -> None:
    """Execute grasps while the network is sure of them: what is left is what it finds hard."""
    for _ in range(simulation.num_objects - 1):
        observation = simulation.observe(
            streams[CAMERA_STREAM],
            streams[NOISE_STREAM],
            views=TRAINING_VIEWS,
            noise_std=noise_std,
        )
        if len(observation.cloud) == 0 or simulation.num_objects <= 1:
            return
        seed = int(streams[CHOICE_STREAM].integers(2**32))
        grasps = guide.detect(observation.cloud, _request(observation, seed)).grasps
        if not grasps or grasps[0].score < SURE:
            return
        simulation.execute_grasp(grasps[0].T_cloud_hand)


def _variety(kind: SceneKind, rng: np.random.Generator) -> tuple[SceneKind, tuple[float, float]]:
    """Whose objects a scene is made of, and the range of their scales."""
    source = kind
    if rng.random() < OTHER_OBJECTS:
        source = SceneKind.PILE if kind is SceneKind.PACKED else SceneKind.PACKED
    low, high = PACKED_SCALE if kind is SceneKind.PACKED else PILE_SCALE
    return source, (low * WIDER_SCALES[0], high * WIDER_SCALES[1])


def _request(observation: Observation, seed: int) -> DetectOptions:
    """What a benchmark asks of the pipeline for such an observation, around fewer points."""
    low, high = observation.workspace.tolist()
    return DetectOptions(
        num_approach_points=APPROACH_POINTS,
        seed=seed,
        viewpoint=tuple(observation.camera_position.tolist()),
        support=SupportPlane(normal=(0.0, 0.0, 1.0), offset=observation.table_height),
        workspace=Workspace(min=tuple(low), max=tuple(high)),
        collision=Collision(mode="penalise"),
    )


def _label(
    simulation: ClutterSimulation,
    observation: Observation,
    options: GenerationOptions,
    rng: np.random.Generator,
) -> LabelledView:
    """Sample candidates as the detector does and try some of them."""
    if len(observation.cloud) == 0:
        return _empty(observation)
    request = _request(observation, int(rng.integers(2**32)))
    guide = None if options.weights is None else _detector(options.weights)
    if guide is None:
        scene, sample, score = *_sampled(observation, request), None
    else:
        prepared = guide.prepare(observation.cloud, request)
        scene, sample = prepared.scene, prepared.sample
        score = None if prepared.batch is None else guide.run(prepared.batch)
    if scene is None or sample is None:
        return _empty(observation)
    candidates = sample.candidates.take(_chosen(sample, score, options, rng))
    T_world_hand = scene.frame.poses_in_cloud(candidates.T_cloud_hand)
    results = [simulation.try_grasp(pose, shake=True) for pose in T_world_hand]
    return LabelledView(
        points=scene.points_in_cloud,
        normals=scene.frame.directions_in_cloud(scene.cloud.normals),
        camera_position=observation.camera_position,
        approach_index=candidates.approach_index,
        contact_index=candidates.contact_index,
        T_world_hand=T_world_hand,
        success=np.asarray([result.success for result in results], dtype=np.int8),
        firm=np.asarray([bool(result.held_after_shaking) for result in results], dtype=np.int8),
    )


@lru_cache(maxsize=1)
def _detector(weights: Path) -> GraspDetector:
    return GraspDetector.load(weights)


def _sampled(
    observation: Observation, request: DetectOptions
) -> tuple[Scene | None, Sample | None]:
    """The scene and its candidates, as the detector makes them, without a network."""
    scene = build_scene(check_cloud(observation.cloud), request, VOXEL_SIZE, {}, [])
    if scene is None:
        return None, None
    return scene, sample_candidates(scene, request, load_gripper(), SAMPLED_RADIUS, {})


def _chosen(
    sample: Sample,
    logit: NDArray[np.floating] | None,
    options: GenerationOptions,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Ascending rows of the candidates to try.

    Some that a network would execute, as many whose outcome it leaves open, and the rest at
    random: mostly hands that are free of collision. Fewer where the best one is sure to hold.
    """
    left = np.ones(len(sample.candidates), dtype=bool)
    total, guided = options.grasps_per_view, 0
    if logit is not None:
        score = 1.0 / (1.0 + np.exp(-logit))
        free = np.flatnonzero(sample.collision_free)
        ranked = free[np.argsort(-logit[free])][: round(BEST_SHARE * len(logit)) + 1]
        if len(ranked) > 0 and score[ranked[0]] >= SURE:
            total = round(EASY_SHARE * total)
        each = round(options.guided_share * total / 2)
        first, others = ranked[: each // 2], ranked[each // 2 :]
        left[first] = False
        left[rng.permutation(others)[: each - len(first)]] = False
        unsure = np.flatnonzero(left & (score > UNSURE[0]) & (score < UNSURE[1]))
        left[rng.permutation(unsure)[:each]] = False
        guided = int((~left).sum())
    count = total - guided
    free = rng.permutation(np.flatnonzero(left & sample.collision_free))
    hit = rng.permutation(np.flatnonzero(left & ~sample.collision_free))
    free = free[: max(round(options.free_share * count), count - len(hit))]
    left[free] = False
    left[hit[: count - len(free)]] = False
    return np.flatnonzero(~left)


def _empty(observation: Observation) -> LabelledView:
    nothing = np.empty((0, 3), dtype=np.float32)
    rows = np.empty(0, dtype=np.int64)
    return LabelledView(
        nothing,
        nothing,
        observation.camera_position,
        rows,
        rows,
        None,
        rows.astype(np.int8),
    )
