"""The pipeline on a device finds what the one on the processor finds, stage by stage."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.cloud_input import CloudInput
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.on_device.detector import DeviceDetector
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Detection

CONFIGS = {
    "plain": NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (8, 8), crop_radius=0.04),
    "vn": NetworkConfig("vn-edgegrasp", (6, 6, 6), (6, 6, 6), (6, 6), (6, 6), crop_radius=0.04),
    "hand": NetworkConfig("hand", hand_widths=(8, 8), classifier_widths=(8, 8), crop_radius=0.04),
}
TABLE = {"normal": (0.0, 0.0, 1.0), "offset": 0.0}
VIEW = (0.3, 0.1, 0.5)
SMALL = {"num_approach_points": 6, "num_candidates": 150, "viewpoint": VIEW, "support": TABLE}
WALL = {"kind": "box", "min": [0.03, -1, -1], "max": [1, 1, 1]}
TILTED = {
    "kind": "oriented_box",
    "center": [0.0, 0.09, 0.1],
    "half_extents": [0.2, 0.01, 0.02],
    "quaternion": [0.1, 0.2, 0.3, 0.86**0.5],
}
NEAR_TOP = {"kind": "sphere", "center": [0.0, 0.0, 0.08], "radius": 0.03}
RANSAC = {"kind": "ransac", "distance": 0.003}
WRONG = {"normal": (0.0, 0.0, 1.0), "offset": 0.004, "max_depth_error": 0.1}

OPTIONS: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "nothing known": {"viewpoint": None, "support": None},
    "tilted": {"up": (0.3, 0.1, 1.0), "support": None},
    "uniform": {"sampling": "uniform", "seed": 7},
    "all checked": {"num_candidates": 16000},
    "ransac": {"support": RANSAC},
    "wrong depths": {"support": WRONG},
    "workspace": {"workspace": {"min": (-0.015, -0.1, 0.01), "max": (0.1, 0.1, 0.2)}},
    "regions": {
        "approach_region": {"include": [NEAR_TOP]},
        "contact_region": {"exclude": [{"kind": "indices", "indices": list(range(0, 900))}]},
    },
    "cones": {"approach_direction": {"cones": [{"direction": (1, 1, -1), "max_angle": 1.0}]}},
    "side": {"approach_direction": {"preset": "side"}},
    "obstacles": {"collision": {"obstacles": [WALL, TILTED], "mode": "penalise"}},
    "lifted": {"collision": {"retreat_direction": "up", "retreat_length": 0.08, "margin": 0.002}},
    "far way in": {"collision": {"approach_length": 0.3, "mode": "penalise"}},
    "ignore": {"collision": "ignore", "order": "highest", "min_score": 0.3, "top_k": 7},
    "clearance": {"order": "clearance", "suppression": None},
    "strict": {"suppression": {"translation": 0.03, "rotation": 3.2}, "top_k": 3},
    "other hand": {"gripper": "robotiq-2f-85"},
    "nobody there": {"workspace": {"min": (1, 1, 1), "max": (2, 2, 2)}},
    "no approach point": {
        "approach_region": {"include": [{"kind": "sphere", "center": [1, 1, 1], "radius": 0.1}]}
    },
    "blocked": {
        "collision": {"obstacles": [{"kind": "box", "min": [-1, -1, -1], "max": [1, 1, 1]}]}
    },
}


def pair(name: str) -> tuple[GraspDetector, DeviceDetector]:
    """Detectors with the same random weights, on the processor and on a device."""
    config = CONFIGS[name]
    metadata = CheckpointMetadata("tiny", config, voxel_size=0.0045, gripper="panda")
    network = build_network(config, torch.Generator().manual_seed(3))
    hand = load_gripper("panda")
    return GraspDetector(network, metadata, hand), DeviceDetector(network, metadata, hand)


def ask(**fields: Any) -> DetectOptions:
    return DetectOptions.model_validate({**SMALL, "debug": True, **fields})


def assert_same(there: Detection, here: Detection) -> None:
    """The same candidates with the same fate, scores and grasps; the same words."""
    assert there.counts == here.counts
    assert there.warnings == here.warnings
    assert list(there.seconds) == list(here.seconds)
    assert len(there.grasps) == len(here.grasps)
    for one, other in zip(there.grasps, here.grasps, strict=True):
        assert one.score == pytest.approx(other.score, abs=1e-4)
        np.testing.assert_allclose(one.T_cloud_hand, other.T_cloud_hand, atol=1e-5)
        np.testing.assert_allclose(one.T_cloud_tcp, other.T_cloud_tcp, atol=1e-5)
        np.testing.assert_allclose(one.approach_point, other.approach_point, atol=1e-6)
        np.testing.assert_allclose(one.contact_point, other.contact_point, atol=1e-6)
        assert one.width == pytest.approx(other.width, abs=1e-5)
        assert one.clearance == pytest.approx(other.clearance, abs=1e-5)
        assert one.collision_free == other.collision_free
    assert (there.debug is None) == (here.debug is None)
    if there.debug is not None and here.debug is not None:
        for name in ("points", "normals", "T_cloud_hand", "score"):
            one, other = getattr(there.debug, name), getattr(here.debug, name)
            np.testing.assert_allclose(one, other, atol=1e-4)
        for name in ("approach_index", "contact_index", "outcome"):
            np.testing.assert_array_equal(getattr(there.debug, name), getattr(here.debug, name))


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_the_same_grasps_whatever_is_asked(
    box_on_table: Callable[..., NDArray[np.float32]], options: dict[str, Any]
) -> None:
    cloud = box_on_table(seed=1, count=500, table=options.get("support") in (RANSAC, WRONG))
    there, here = pair("hand")
    asked = ask(**options)
    found = there.detect(cloud, asked)
    assert_same(found, here.detect(cloud, asked))
    empty = options in (OPTIONS["nobody there"], OPTIONS["no approach point"], OPTIONS["blocked"])
    assert bool(found.grasps) != empty
    assert ("multiplied" in "".join(found.warnings)) == (options == OPTIONS["wrong depths"])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", CONFIGS)
def test_the_same_grasps_of_every_network(
    box_on_table: Callable[..., NDArray[np.float32]], name: str, seed: int
) -> None:
    cloud, (there, here) = box_on_table(seed=seed, count=600), pair(name)
    found = there.detect(cloud, ask(seed=seed))
    assert found.grasps
    assert_same(found, here.detect(cloud, ask(seed=seed)))


def test_the_same_grasps_of_a_cloud_with_all_that_comes_with_it(
    box_on_table: Callable[..., NDArray[np.float32]],
) -> None:
    points = box_on_table(seed=2, count=500)
    organised = np.full((30, 60, 3), np.nan, np.float32)
    organised.reshape(-1, 3)[: len(points)] = points
    rng = np.random.default_rng(0)
    view_ids = rng.integers(0, 2, (30, 60))
    two = {"viewpoint": [VIEW, (-0.4, 0.0, 0.4)]}
    outward = np.zeros((1800, 3), np.float32)
    outward[: len(points)] = points - points.mean(axis=0)
    outward[:300] = 0.0  # normals that say nothing
    there, here = pair("hand")
    points.setflags(write=False)  # as the bytes of a message are
    assert_same(there.detect(points, ask()), here.detect(points, ask()))
    for sent in (
        CloudInput(organised, view_ids=view_ids),
        CloudInput(organised, view_ids=view_ids, normals=outward.reshape(30, 60, 3)),
    ):
        assert_same(there.detect(sent, ask(**two)), here.detect(sent, ask(**two)))


def test_few_points_and_flat_ones() -> None:
    corners = [[0, 0, 0.1], [0.2, 0, 0.1], [0, 0.2, 0.1], [0.2, 0.2, 0.1], [0.1, 0.1, 0.2]]
    apart = np.float32(corners)
    rng = np.random.default_rng(4)
    sheet = np.column_stack((rng.uniform(-0.03, 0.03, (400, 2)), np.full(400, 0.012)))
    there, here = pair("plain")
    for cloud, fields in (
        (apart, {"num_approach_points": 5}),
        (apart[:3], {"num_approach_points": 2}),
        (sheet.astype(np.float32), {}),
    ):
        assert_same(there.detect(cloud, ask(**fields)), here.detect(cloud, ask(**fields)))


@pytest.mark.parametrize("name", ["plain", "hand"])
def test_given_grasps_score_alike(
    box_on_table: Callable[..., NDArray[np.float32]], name: str
) -> None:
    cloud, (there, here) = box_on_table(count=500), pair(name)
    edges = np.random.default_rng(0).integers(0, len(cloud), (40, 2))
    one = there.score(cloud, ask(debug=False), edges=edges)
    other = here.score(cloud, ask(debug=False), edges=edges)
    assert one.counts == other.counts
    assert [each.reason for each in one.evaluations] == [each.reason for each in other.evaluations]
    scores = [[e.grasp.score for e in found.evaluations if e.grasp] for found in (one, other)]
    assert len(scores[0]) > 2
    np.testing.assert_allclose(*scores, atol=1e-4)


@pytest.mark.parametrize("name", CONFIGS)
def test_requests_that_share_a_pass_get_their_own_grasps(
    box_on_table: Callable[..., NDArray[np.float32]], name: str
) -> None:
    """As the server does it: prepared one by one, scored in one batch, finished one by one."""
    there, here = pair(name)
    clouds = [box_on_table(seed=seed, count=400) for seed in (3, 4)]
    prepared = [here.prepare(cloud, ask()) for cloud in clouds]
    batches = [one.batch for one in prepared if one.batch is not None]
    assert len(batches) == 2
    logits = here.run(type(batches[0]).concatenate(batches))  # type: ignore[arg-type]
    parts = np.split(logits, [len(batches[0].contact)])
    for cloud, one, part in zip(clouds, prepared, parts, strict=True):
        one.seconds["network"] = 0.0
        assert_same(there.detect(cloud, ask()), here.finish(one, part))
