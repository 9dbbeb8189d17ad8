"""Generate labelled views: observe random clutter, try edge grasps in it, keep what happened."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.cloud_input import check_cloud
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import Collision, DetectOptions, SupportPlane, Workspace
from edgegrasp_model.preparation import Sample, sample_candidates
from edgegrasp_model.scene import build_scene
from edgegrasp_sim.camera import TRAINING_VIEWS
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, Observation
from edgegrasp_training.views import LabelledView

SCENE_STREAM, CAMERA_STREAM, NOISE_STREAM, CHOICE_STREAM = 0, 1, 2, 3
VOXEL_SIZE = 0.0045  # metres
SAMPLED_RADIUS, SAMPLED_K = 0.04, 16  # balls that candidates are drawn from
APPROACH_POINTS = 12  # few balls with many tried grasps each cost the trainer least per label
MEAN_FURTHER_OBJECTS = 4  # a scene holds one object and Poisson(this) more


@dataclass(frozen=True)
class GenerationOptions:
    """What to generate."""

    scenes: int = 100
    views_per_scene: int = 2
    grasps_per_view: int = 100
    free_share: float = 0.75  # of the tried grasps, those the cloud says are free of collision
    noise_std: float = 0.001  # metres
    seed: int = 1


def scene_name(index: int, seed: int) -> str:
    """Name of a generated scene; even indices are packed, odd ones piles."""
    kind = SceneKind.PACKED if index % 2 == 0 else SceneKind.PILE
    return f"{kind.value}_{seed}-{index:06d}"


def view_path(folder: Path, index: int, view: int, seed: int) -> Path:
    """File of a view."""
    return folder / f"{scene_name(index, seed)}_{view}.npz"


def missing_scenes(folder: Path, options: GenerationOptions) -> list[int]:
    """Indices of the scenes that lack a view."""
    return [
        index
        for index in range(options.scenes)
        if not all(
            view_path(folder, index, view, options.seed).is_file()
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
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = {
            pool.submit(generate_scene, folder, objects, options, index): index for index in missing
        }
        for future in as_completed(futures):
            yield futures[future], *future.result()


def generate_scene(
    folder: Path, objects: Path | None, options: GenerationOptions, index: int
) -> tuple[int, int]:
    """Generate all views of one scene; how many grasps were tried and how many held."""
    kind = SceneKind.PACKED if index % 2 == 0 else SceneKind.PILE
    sets = None if objects is None else {kind: ObjectSet.from_folder(objects, kind, "train")}
    streams = [np.random.default_rng([options.seed, index, stream]) for stream in range(4)]
    tried = held = 0
    with ClutterSimulation(sets) as simulation:
        count = 1 + int(streams[SCENE_STREAM].poisson(MEAN_FURTHER_OBJECTS))
        simulation.reset(kind, streams[SCENE_STREAM], count)
        for view_number in range(options.views_per_scene):
            observation = simulation.observe(
                streams[CAMERA_STREAM],
                streams[NOISE_STREAM],
                views=TRAINING_VIEWS,
                noise_std=options.noise_std,
            )
            view = _label(simulation, observation, options, streams[CHOICE_STREAM])
            view.save(view_path(folder, index, view_number, options.seed))
            tried += len(view.tried())
            held += int((view.success == 1).sum())
    return tried, held


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
    gripper = load_gripper()
    request = _request(observation, int(rng.integers(2**32)))
    if len(observation.cloud) == 0:
        return _empty(observation)
    scene = build_scene(check_cloud(observation.cloud), request, VOXEL_SIZE, {}, [])
    if scene is None:
        return _empty(observation)
    sample = sample_candidates(scene, request, gripper, SAMPLED_RADIUS, SAMPLED_K, {})
    rows = _chosen(sample, options, rng)
    candidates = sample.candidates.take(rows)
    T_world_hand = scene.frame.poses_in_cloud(candidates.T_cloud_hand)
    outcomes = [simulation.try_grasp(pose).success for pose in T_world_hand]
    return LabelledView(
        points=scene.points_in_cloud,
        normals=scene.frame.directions_in_cloud(scene.cloud.normals),
        camera_position=observation.camera_position,
        approach_index=candidates.approach_index,
        contact_index=candidates.contact_index,
        T_world_hand=T_world_hand,
        success=np.asarray(outcomes, dtype=np.int8),
    )


def _chosen(
    sample: Sample, options: GenerationOptions, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Ascending rows of the candidates to try: mostly hands that are free of collision."""
    free = rng.permutation(np.flatnonzero(sample.collision_free))
    hit = rng.permutation(np.flatnonzero(~sample.collision_free))
    wanted = round(options.free_share * options.grasps_per_view)
    free = free[: max(wanted, options.grasps_per_view - len(hit))]
    return np.sort(np.concatenate([free, hit[: options.grasps_per_view - len(free)]]))


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
