"""Generate labelled views: observe random clutter, try edge grasps in it, keep what happened."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.options import Collision, DetectOptions, SupportPlane, Workspace
from edgegrasp_sim.camera import TRAINING_VIEWS
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.scene import PACKED_SCALE, PILE_SCALE
from edgegrasp_sim.simulation import NOISE_STD, ClutterSimulation
from edgegrasp_training.labelling import SURE, Choice, Question, detector, label
from edgegrasp_training.varied_objects import varied_objects
from edgegrasp_training.views import LabelledView

SCENE_STREAM, CAMERA_STREAM, NOISE_STREAM, CHOICE_STREAM, SHAPE_STREAM = 0, 1, 2, 3, 4
APPROACH_POINTS = 12  # few balls with many tried grasps each cost the trainer least per label
MEAN_FURTHER_OBJECTS = 4  # a scene holds one object and Poisson(this) more
OTHER_OBJECTS = 0.3  # share of the scenes made of the other kind's objects: shapes of every sort
VARIED_SHARE = 0.85  # of the scenes of an object folder, made of stretched and made objects
WIDER_SCALES = 0.85, 1.15  # factors on both ends of the scales of a scene
HARD_SHARE = 0.8  # of the scenes, in which a network's surest grasp is looked for that fails
HARD_LOOKS = 3  # scenes that are looked through for it
OTHER_NOISE = 0.3  # share of the views that have another noise than the benchmark's
NOISIEST = 0.003  # metres, the most


@dataclass(frozen=True)
class GenerationOptions:
    """What to generate."""

    scenes: int = 100
    views_per_scene: int = 2
    grasps_per_view: int = 100
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
            hard = _make_scene(simulation, kind, scales, options, streams)
            for number, view in enumerate(_views(simulation, hard, options, streams)):
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
    return varied_objects(plain, folder, rng)


def _make_scene(
    simulation: ClutterSimulation,
    kind: SceneKind,
    scales: tuple[float, float],
    options: GenerationOptions,
    streams: list[np.random.Generator],
) -> Question | None:
    """Make a scene; where there are weights, mostly one with a view that they find hard."""
    rng = streams[SCENE_STREAM]
    guide = None
    if options.weights is not None and rng.random() < HARD_SHARE:
        guide = detector(options.weights)
    for _ in range(1 if guide is None else HARD_LOOKS):
        simulation.reset(kind, rng, 1 + int(rng.poisson(MEAN_FURTHER_OBJECTS)), scales)
        hard = None if guide is None else _hard_view(simulation, guide, options, streams)
        if hard is not None:
            return hard
    return None


def _hard_view(
    simulation: ClutterSimulation,
    guide: GraspDetector,
    options: GenerationOptions,
    streams: list[np.random.Generator],
) -> Question | None:
    """The first view in which the network is unsure of its best grasp, or sure and wrong.

    Until then its grasps are executed, so that what it finds easy is gone. None if all is easy.
    """
    for _ in range(simulation.num_objects):
        question = _ask(simulation, options, streams)
        if len(question.observation.cloud) == 0:
            return None
        grasps = guide.detect(question.observation.cloud, question.request).grasps
        if not grasps or grasps[0].score < SURE:
            return question
        if not simulation.try_grasp(grasps[0].T_cloud_hand).success:
            return question
        if simulation.num_objects == 1:
            return None
        simulation.execute_grasp(grasps[0].T_cloud_hand)
    return None


def _ask(
    simulation: ClutterSimulation, options: GenerationOptions, streams: list[np.random.Generator]
) -> Question:
    """Look at the scene, and ask for grasps as a benchmark does, around fewer points."""
    observation = simulation.observe(
        streams[CAMERA_STREAM],
        streams[NOISE_STREAM],
        views=TRAINING_VIEWS,
        noise_std=_noise_std(streams[NOISE_STREAM]),
    )
    low, high = observation.workspace.tolist()
    request = DetectOptions(
        num_approach_points=APPROACH_POINTS,
        seed=int(streams[CHOICE_STREAM].integers(2**32)),
        viewpoint=tuple(observation.camera_position.tolist()),
        support=SupportPlane(normal=(0.0, 0.0, 1.0), offset=observation.table_height),
        workspace=Workspace(min=tuple(low), max=tuple(high)),
        collision=Collision(mode="penalise"),
    )
    return Question(observation, request)


def _views(
    simulation: ClutterSimulation,
    hard: Question | None,
    options: GenerationOptions,
    streams: list[np.random.Generator],
) -> Iterator[LabelledView]:
    """Labelled views of the scene that stands in the simulation, the hard one first."""
    choice = Choice(options.grasps_per_view, options.weights, hard is not None)
    models = [model.origin or model for model in simulation.object_models]
    names, digests = tuple(m.name for m in models), tuple(m.digest for m in models)
    for number in range(options.views_per_scene):
        question = hard if hard and number == 0 else _ask(simulation, options, streams)
        yield replace(
            label(simulation, question, choice, streams[CHOICE_STREAM]),
            objects=names,
            object_digests=digests,
        )


def _noise_std(rng: np.random.Generator) -> float:
    """Noise of a view, metres: mostly the benchmark's."""
    return rng.uniform(0.0, NOISIEST) if rng.random() < OTHER_NOISE else NOISE_STD


def _variety(kind: SceneKind, rng: np.random.Generator) -> tuple[SceneKind, tuple[float, float]]:
    """Whose objects a scene is made of, and the range of their scales."""
    source = kind
    if rng.random() < OTHER_OBJECTS:
        source = SceneKind.PILE if kind is SceneKind.PACKED else SceneKind.PACKED
    low, high = PACKED_SCALE if kind is SceneKind.PACKED else PILE_SCALE
    return source, (low * WIDER_SCALES[0], high * WIDER_SCALES[1])
