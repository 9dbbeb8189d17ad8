"""Generate labelled views: observe random clutter, try edge grasps in it, keep the outcomes."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_model.candidates.edge_grasps import Candidates
from edgegrasp_model.candidates.sample import Sample, Sampler
from edgegrasp_model.detector import WEIGHTS_FOLDER, GraspDetector, Prepared
from edgegrasp_model.gripper import gripper_fields
from edgegrasp_model.options import DetectOptions, SupportPlane
from edgegrasp_model.ranking import average_similar_hands
from edgegrasp_model.scene.scene import Scene
from edgegrasp_sim.camera import Observation, TableView, ViewRange
from edgegrasp_sim.engine import choose_engine
from edgegrasp_sim.fixed_parts import MIDDLE, TABLE_HEIGHT
from edgegrasp_sim.hand import FINGERTIP
from edgegrasp_sim.objects import CLUTTER, ObjectSet, SceneKind
from edgegrasp_sim.poses import about_z
from edgegrasp_sim.scene import SCALES
from edgegrasp_sim.sensor import random_sensor
from edgegrasp_sim.simulation import NOISE_STD, ClutterSimulation
from edgegrasp_sim.workers import run_tasks
from edgegrasp_training.options import GenerationOptions
from edgegrasp_training.shapes import household_objects, varied_objects
from edgegrasp_training.views import TABLE as TABLE_PLANE
from edgegrasp_training.views import LabelledView, load_view

APPROACH_POINTS = 12  # few balls with many labels each are the cheapest to train on
BIN_APPROACH_POINTS = 24  # walls block most hands in bins
PACKED, PILE, BIN, TABLE, FULL_BIN, DEEP_BIN, SHELF = SceneKind
BINS = BIN, DEEP_BIN, FULL_BIN  # observed only from above
# Four in ten scenes are of the kinds of the paper's benchmark.
MIXTURE = (PACKED, PILE, BIN, TABLE, BIN, PACKED, TABLE, PILE, BIN, TABLE)
# A scene has one object and Poisson(this) more.
FURTHER_OBJECTS = {PACKED: 4, PILE: 4, BIN: 7, DEEP_BIN: 9, FULL_BIN: 24, TABLE: 5, SHELF: 3}
_ANY_SIDE = (0.0, 360.0)  # degrees, like the other angles
_HIGH, _LOW = (MIDDLE, MIDDLE, 0.25), (MIDDLE, MIDDLE, 0.1)  # metres, looked at
VIEWS = {
    **dict.fromkeys((PACKED, PILE), ViewRange((0.45, 0.75), (0.0, 75.0), _ANY_SIDE, _HIGH)),
    **dict.fromkeys(BINS, ViewRange((0.5, 1.1), (0.0, 40.0), _ANY_SIDE, _LOW)),
    TABLE: ViewRange((0.5, 1.2), (20.0, 75.0), _ANY_SIDE, _LOW),
    SHELF: ViewRange((0.45, 1.0), (45.0, 90.0), (230.0, 310.0), _LOW),
}
# Household objects are observed more from the side, where a tall or wide object hides its back.
SIDE_VIEWS = ViewRange((0.5, 1.2), (40.0, 80.0), _ANY_SIDE, _LOW)
# Metres from the nearest tried hand: from a Panda's hand frame with the same fingertips.
KEPT_DISTANCE = 0.18
AROUND_SHARE = 0.3  # share of the views of packed scenes and piles that are not cropped
# Share of the views without cropping for which support and workspace are given; else neither.
GIVEN_SHARE = {BIN: 0.7, DEEP_BIN: 0.5, FULL_BIN: 0.5, TABLE: 0.3, SHELF: 0.3}
AIMED_SHARE = 0.85  # share of the views of bins, tables and shelves with grasps only on objects
AIM_MARGIN = np.array([[-0.005], [0.005]])  # metres around an object
AROUND_MARGIN = 0.006  # metres around an obstacle
PLANE_TILT, PLANE_ERROR = 0.006, 0.001  # radians, metres; standard deviations
OTHER_OBJECTS = 0.3  # share of the scenes with objects of the other kind
VARIED_SHARE = 0.85  # share of an object folder's scenes with stretched and computed objects
NUM_HOUSEHOLD = 12  # household objects that a scene is drawn from,
HOUSEHOLD_SCALE = 0.9, 1.1  # and the range of their scales
WIDER_SCALES = 0.85, 1.15  # factors on the ends of a scene's range of scales
CLEARED_SHARE = 0.75  # share of the scenes that the network clears like a robot
FAILURES = 2  # consecutive failures after which it gets another scene
SENSOR_SHARE = 0.4  # share of the views with the faults of a depth camera
OTHER_NOISE = 0.3  # share of the views with noise that differs from the benchmark's
MAX_NOISE = 0.004  # metres

FREE_SHARE = 0.75  # collision-free share of the grasps chosen at random
LIKELY, LIKELY_SHARE = 1 / 3, 0.7  # best part of an object's grasps, and its share of the tries

Query = tuple[Observation, DetectOptions]  # a view of a scene, and a request for grasps in it
load_detector = lru_cache(maxsize=2)(GraspDetector.load)  # loads weights once in a process
DEFAULT_WEIGHTS = WEIGHTS_FOLDER / "edgegrasp-plus.safetensors"  # for views without a guide


def generate(
    folder: Path,  # for the views, one file each
    objects: Path | None,  # folder with `packed/train`, `pile/train`; None: built-in objects
    options: GenerationOptions,  # what to generate
    workers: int | None = 1,  # how many scenes at a time, and
    ray: str | None = None,  # address of a Ray cluster, see `run_tasks`; views come back
) -> Iterator[tuple[int, int, int]]:
    """Generate the missing scenes; yields each one's index, grasps tried, and grasps that held."""
    folder.mkdir(parents=True, exist_ok=True)
    # Other machines need absolute paths.
    weights, objects = (path and path.resolve() for path in (options.weights, objects))
    if weights is not None:
        load_detector(weights)  # refuses wrong weights now, not when the first scene is cleared
    changes = {"engine": choose_engine(options.engine), "weights": weights}
    options = options.model_copy(update=changes)
    # One view of each kind and seed: all scenes of a seed are made by the same engine.
    some = {path.name.rsplit("-", 1)[0]: path for path in folder.glob("*.npz")}
    if other := {load_view(path).engine for path in some.values()} - {options.engine}:
        raise ValueError(
            f"{folder} holds labels of {', '.join(other)}, not of {options.engine}; "
            "choose another folder"
        )
    made = folder / f"seed_{options.seed}.json"
    decisive = {*GenerationOptions.model_fields} - {"scenes", "views_per_scene"}
    given = options.model_dump(mode="json", include=decisive) | {
        "objects": objects and str(objects)
    }
    begun = made.is_file() and any(folder.glob(f"*_{options.seed}-*.npz"))
    before = json.loads(made.read_text()) if begun else given
    if changed := [name for name, value in given.items() if before.get(name) != value]:
        raise ValueError(
            f"{', '.join(changed)}: {folder} holds scenes of seed {options.seed} that were made "
            "with other values; choose another folder or seed"
        )
    made.write_text(json.dumps(given))
    missing = missing_scenes(folder, options)
    sets = {}
    if objects is not None:
        wanted = {kind_of(options, index).objects for index in missing}
        there = [kind for kind in CLUTTER if kind in wanted or (objects / kind).is_dir()]
        sets = {kind: ObjectSet.from_folder(objects, kind, "train") for kind in there}
    digests = [drawn.digest for drawn in sets.values()]
    make_runner = partial(_scene_maker, sets, digests, options)
    for index, views in run_tasks(make_runner, missing, workers=workers, ray=ray):
        for path, view in zip(view_paths(folder, index, options), views, strict=True):
            view.save(path)
        tried = sum(len(view.tried()) for view in views)
        yield index, tried, sum(int((view.success == 1).sum()) for view in views)


def missing_scenes(folder: Path, options: GenerationOptions) -> list[int]:
    """Indices of the scenes that lack a view."""
    scenes = {index: view_paths(folder, index, options) for index in range(options.scenes)}
    return [index for index, paths in scenes.items() if not all(map(Path.is_file, paths))]


def kind_of(options: GenerationOptions, index: int) -> SceneKind:
    """The kind of a scene."""
    return SceneKind(options.scene) if options.scene else MIXTURE[index % len(MIXTURE)]


def view_paths(folder: Path, index: int, options: GenerationOptions) -> list[Path]:
    """Files of a scene's views."""
    name = f"{kind_of(options, index)}_{options.seed}-{index:06d}"
    return [folder / f"{name}_{view}.npz" for view in range(options.views_per_scene)]


def _scene_maker(
    sets: dict[SceneKind, ObjectSet], digests: list[str], options: GenerationOptions
) -> Callable[[int], list[LabelledView]]:
    for drawn, digest in zip(sets.values(), digests, strict=True):
        drawn.check_same(digest)
    return partial(generate_scene, sets, options)


def generate_scene(
    sets: dict[SceneKind, ObjectSet], options: GenerationOptions, index: int
) -> list[LabelledView]:
    """Generate all views of one scene; without sets, the scene has built-in objects."""
    streams = [np.random.default_rng([options.seed, index, stream]) for stream in range(7)]
    scene, *of_views, shape, hand, household = streams
    kind = kind_of(options, index)
    # Some scenes have objects of the other kind, if there are any.
    source = kind.objects
    if scene.random() < OTHER_OBJECTS:
        other = PILE if source is PACKED else PACKED
        source = other if other in sets else source
    gripper = None  # the Panda's
    if options.gripper == "random":
        gripper = random_gripper(hand)
    elif options.gripper != "panda":
        gripper = gripper_fields(options.gripper)
    low, high = SCALES[kind.objects]
    sizes, seen_from = (low * WIDER_SCALES[0], high * WIDER_SCALES[1]), VIEWS[kind]
    drawn = sets.get(source)
    with TemporaryDirectory() as folder:
        if options.household > household.random():
            drawn = household_objects(Path(folder), NUM_HOUSEHOLD, household)
            sizes = HOUSEHOLD_SCALE
            seen_from = SIDE_VIEWS if kind in (PACKED, PILE, TABLE) else seen_from
        elif drawn is not None and shape.random() < VARIED_SHARE:
            drawn = varied_objects(drawn, Path(folder), shape)
        with ClutterSimulation(drawn, engine=options.engine, gripper=gripper) as simulation:
            return list(_views(simulation, kind, sizes, seen_from, options, scene, of_views))


def _views(
    simulation: ClutterSimulation,
    kind: SceneKind,
    sizes: tuple[float, float],  # range of the objects' scales
    seen_from: ViewRange,
    options: GenerationOptions,
    rng: np.random.Generator,  # of the objects
    of_views: Sequence[np.random.Generator],  # of cameras, of noise, of requests and grasps
) -> Iterator[LabelledView]:
    """The views of one scene; in some scenes, the given network clears it between the views."""
    (camera, noise, choice), hand = of_views, simulation.gripper
    guide, failures = None, FAILURES
    if options.weights is not None and rng.random() < CLEARED_SHARE:
        guide = load_detector(options.weights)
    for _ in range(options.views_per_scene):
        if simulation.num_objects == 0 or failures == FAILURES:
            simulation.reset(kind, rng, 1 + int(rng.poisson(FURTHER_OBJECTS[kind])), sizes)
            failures = 0
        models = [model.unstretched or model for model in simulation.object_models]
        cameras, guided = seen_from.sample(camera), guide is not None
        query, sensor = observe_and_request(simulation, kind, cameras, noise, choice, guided=guided)
        view, best = label_view(simulation, query, options, choice, guide)
        yield replace(
            view,
            gripper="" if hand is None else json.dumps(hand),
            engine=simulation.world.name,
            sensor=sensor,
            objects=tuple(model.name for model in models),
            object_digests=tuple(model.digest for model in models),
        )
        if guide is not None:
            success = best is not None and simulation.execute_grasp(best).success
            failures = 0 if success else failures + 1


def observe_and_request(
    simulation: ClutterSimulation,
    kind: SceneKind,
    cameras: Sequence[Float64],  # (4, 4) T_world_camera of each
    noise: np.random.Generator,  # of the observation and of the given support
    choice: np.random.Generator,  # of the rest of the request
    *,
    guided: bool,  # whether a network clears the scene and needs a robot's full request
) -> tuple[Query, str]:
    """Observe the scene and make a request like a benchmark's; unless guided, for a few balls.

    In bins, on tables and shelves and in some other views, the cloud contains all that the camera
    sees, and the support is given with an error, or has to be found.
    """
    open_table = kind in (PACKED, PILE)
    around = not open_table or noise.random() < AROUND_SHARE
    draw, seen, sensor = noise.random(), dict[str, Any](noise_std=NOISE_STD), "ideal"
    if draw < SENSOR_SHARE:  # a camera's faults
        fault = random_sensor(noise)
        seen, sensor = {"noise_std": 0.0, "faults": [fault]}, fault.name
    elif draw < SENSOR_SHARE + OTHER_NOISE:
        seen = {"noise_std": noise.uniform(0.0, MAX_NOISE)}
    table: TableView = "around" if around else "known"
    observation = simulation.observe_from(cameras, noise, table=table, **seen)
    support, (low, high) = _plane(noise) if around else TABLE_PLANE, observation.workspace.tolist()
    request: dict[str, Any] = {"support": support, "workspace": {"min": low, "max": high}}
    if around and choice.random() >= GIVEN_SHARE.get(kind, 0.0):
        request = {}
    if not open_table and not guided and choice.random() < AIMED_SHARE:
        request["approach_region"] = request["contact_region"] = _objects_of(simulation)
    few = BIN_APPROACH_POINTS if kind in BINS else APPROACH_POINTS
    request |= {
        "num_approach_points": None if guided else few,
        "seed": int(choice.integers(2**32)),
        "viewpoint": observation.camera_position.tolist(),
        "collision": {"mode": "avoid" if guided else "penalise"},
        "gripper": simulation.gripper,
    }
    return (observation, DetectOptions.model_validate(request)), sensor


def _plane(rng: np.random.Generator) -> SupportPlane:
    """The table's plane with a measurement error."""
    tilted = np.array([*rng.normal(0.0, PLANE_TILT, size=2), 1.0])
    x, y, z = (tilted / np.linalg.norm(tilted)).tolist()
    height = TABLE_HEIGHT + rng.normal(0.0, PLANE_ERROR)
    return SupportPlane(normal=(x, y, z), offset=float((x + y) * MIDDLE + z * height))


def _objects_of(simulation: ClutterSimulation) -> dict[str, Any]:
    """The region of the objects' bounds, without the obstacles around them."""
    boxes = (simulation.object_bounds + AIM_MARGIN).tolist()
    around = [
        {
            "kind": "oriented_box",
            "center": box.centre,
            "half_extents": [size / 2 + AROUND_MARGIN for size in box.size],
            "quaternion": about_z(box.yaw),
        }
        for box in simulation.fixed_parts.boxes
        if box.obstacle
    ]
    include = [{"kind": "box", "min": low, "max": high} for low, high in boxes]
    return {"include": include, "exclude": around}


def label_view(
    simulation: ClutterSimulation,  # contains the scene
    query: Query,  # a view of it and the request
    options: GenerationOptions,  # how many to try
    rng: np.random.Generator,  # chooses among the candidates
    guide: GraspDetector | None,  # guides the choice
) -> tuple[LabelledView, Float32 | None]:
    """Sample candidates like the detector and try some; also returns the guide's best (4, 4)."""
    observation, _ = query
    found = choose_grasps(query, options, rng, guide)
    if found is None:
        nothing, rows = np.empty((0, 3), dtype=np.float32), np.empty(0, dtype=np.int64)
        camera, success = observation.camera_position, rows.astype(np.int8)
        return LabelledView(nothing, nothing, camera, rows, rows, success), None
    prepared, scene, candidates, best = found
    T_world_hand = scene.frame.poses_to_cloud(candidates.T_cloud_hand)
    results = [simulation.try_grasp(pose, shake=True) for pose in T_world_hand]
    targets = [result.target.model.name if result.target else "" for result in results]
    # Points far from every grasp carry no information.
    behind = prepared.gripper.tip_z - FINGERTIP
    places = T_world_hand[:, :3, 3] + np.float32(behind) * T_world_hand[:, :3, 2]
    if len(places) == 0:  # a teacher's grasps are on the objects
        places = scene.points_in_cloud[scene.approach_allowed]
    support = prepared.selected.support
    plane = None if support is None else support.plane
    kept = np.flatnonzero(cKDTree(places).query(scene.points_in_cloud)[0] <= KEPT_DISTANCE)
    view = LabelledView(
        points=scene.points_in_cloud[kept],
        normals=scene.frame.directions_to_cloud(scene.cloud.normals)[kept],
        camera_position=observation.camera_position,
        approach_index=np.searchsorted(kept, candidates.approach_index),
        contact_index=np.searchsorted(kept, candidates.contact_index),
        T_world_hand=T_world_hand,
        success=np.asarray([result.success for result in results], dtype=np.int8),
        firm=np.asarray([bool(result.held_after_shaking) for result in results], dtype=np.int8),
        support=np.array([0.0] * 4 if plane is None else [*plane.normal, plane.offset], np.float32),
        at_side=scene.at_side[kept],
        object_of_point=scene.object_of_point[kept].astype(np.int16),
        targets=np.array(targets, np.str_),
    )
    return view, None if best is None else T_world_hand[best]


def choose_grasps(
    query: Query, options: GenerationOptions, rng: np.random.Generator, guide: GraspDetector | None
) -> tuple[Prepared, Scene, Candidates, int | None] | None:
    """Sample candidates of a view like the detector and choose some; None if there are none.

    The last value is the row of the guide's best among them.
    """
    observation, request = query
    if len(observation.cloud) < (request.num_approach_points or 1):
        return None
    prepared = (guide or load_detector(DEFAULT_WEIGHTS)).prepare(observation.cloud, request)
    scene = prepared.scene
    if scene is None or not scene.approach_allowed.any():
        return None
    given = request, prepared.gripper, prepared.crop_radius, prepared.counts
    sample = guide.evaluate(prepared) if guide else Sampler(scene, *given, sees_hands=True).all()
    if sample is None or len(sample.candidates) == 0:
        return None
    if guide is None:
        rows, best = _any(sample, options.grasps_per_view, rng), None
    else:
        rating = average_similar_hands(sample, scene, prepared.gripper)
        number = scene.object_of_point[sample.candidates.contact_index]
        rows = _likely(number, sample.logits, rating, options.grasps_per_view, rng)
        best = int(np.searchsorted(rows, rating.argmax()))
    return prepared, scene, sample.candidates.take(rows), best


def _any(sample: Sample, total: int, rng: np.random.Generator) -> Int64:
    """Ascending rows of at most `total` candidates to try, most of them collision-free."""
    free = rng.permutation(np.flatnonzero(sample.collision_free))
    hit = rng.permutation(np.flatnonzero(~sample.collision_free))
    free = free[: max(round(FREE_SHARE * total), total - len(hit))]
    return np.sort(np.concatenate([free, hit[: round((1.0 - FREE_SHARE) * total)]]))


def _likely(
    number: Int64,  # (E,) the candidates' objects
    logit: Float32,  # (E,) the network's output
    rating: Float32,  # (E,) the rating by which a robot would choose
    total: int,
    rng: np.random.Generator,
) -> Int64:
    """Ascending rows of about `total` candidates: the best of each object, then mostly likely ones.

    A network trained on randomly drawn grasps overestimates the best grasps.
    """
    chosen, likely = np.zeros((2, len(number)), dtype=bool)
    for each in np.unique(number):
        mine = np.flatnonzero(number == each)
        order = mine[np.argsort(-logit[mine], kind="stable")]
        likely[order] = np.arange(len(mine)) < LIKELY * len(mine)
        chosen[[order[0], mine[rating[mine].argmax()]]] = True
    left = max(total - int(chosen.sum()), 0)
    for group, share in ((likely, LIKELY_SHARE), (~likely, 1.0 - LIKELY_SHARE)):
        further = rng.permutation(np.flatnonzero(~chosen & group))
        chosen[further[: round(share * left)]] = True
    return np.flatnonzero(chosen)


def random_gripper(rng: np.random.Generator) -> dict[str, Any]:
    """The fields of a gripper with random opening and random finger length, width and thickness.

    A finger is a pad, and behind it a root that is at least as thick. Metres.
    """

    def draw(least: float, most: float) -> float:
        return round(rng.uniform(least, most), 4)

    opening, length = draw(0.04, 0.14), draw(0.035, 0.12)  # of a finger, from the palm to its tip
    half_width, thick = draw(0.005, 0.015), draw(0.006, 0.022)  # of a finger, thickness at its tip
    # The palm's z, half the hand's depth, and the extra thickness of a finger's root.
    palm, body, root = draw(0.06, 0.09), draw(0.02, 0.035), draw(0.0, 0.016)
    tip, pad = palm + length, palm + length * rng.uniform(0.2, 0.6)
    side = max(opening / 2 + thick + rng.uniform(-0.03, 0.02), 0.03)
    contact = tip - 0.007  # the same distance from the tips as in all gripper files
    swing: dict[str, float] | None = None
    if rng.random() < 0.4:  # fingers swing on links of this length and outward reach
        radius = rng.uniform(0.05, 0.11)
        swing = {"radius": radius, "reach": min(rng.uniform(0.3, 0.5) * opening, 0.75 * radius)}
    pad_box = [[-half_width, 0.0, pad], [half_width, thick, tip]]
    root_box = [[-half_width, 0.002, palm - 0.005], [half_width, thick + root, pad]]
    return {
        "name": "random",
        "max_opening": opening,
        "tip_z": tip,
        "contact_z": contact,
        "tcp_z": contact,
        "hand": {"boxes": [[[-body, -side, 0.0], [body, side, palm]]]},
        "finger": {"boxes": [pad_box, root_box]},
        "swing": swing,
    }
