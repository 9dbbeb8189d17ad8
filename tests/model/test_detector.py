from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.errors import InvalidCheckpoint, InvalidRequest, UnknownModel
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.checkpoint import build_network, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_model.options import DetectOptions, SupportPlane, Workspace
from edgegrasp_model.results import Detection, Outcome
from edgegrasp_model.scene.cloud import CloudInput

TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (8, 8), crop_radius=0.04)
PLUS = NetworkConfig("hand", hand_widths=(8, 8), classifier_widths=(8, 8), crop_radius=0.04)
VN = NetworkConfig("vn-edgegrasp", (6, 6, 6), (6, 6, 6), (6, 6), (6, 6), crop_radius=0.04)
TABLE = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)
VIEW = (0.3, 0.0, 0.5)


def detector(config: NetworkConfig = PLUS) -> GraspDetector:
    metadata = CheckpointMetadata("tiny", config, voxel_size=0.0045, gripper="panda")
    network = build_network(config, torch.Generator().manual_seed(3))
    return GraspDetector(network, metadata, load_gripper("panda"))


def box_on_table(seed: int = 0, count: int = 4000) -> np.ndarray:
    """The top and two sides of a 40 x 60 x 80 mm box that stands on z = 0."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, 0.5, (2, count))
    size = np.array([0.04, 0.06, 0.08])
    top = np.stack([u, v, np.full(count, 0.5)], axis=1)
    front = np.stack([np.full(count, 0.5), u, v], axis=1)
    side = np.stack([u, np.full(count, 0.5), v], axis=1)
    points = np.concatenate([top, front, side]) * size + (0, 0, 0.04)
    return (points + rng.normal(0, 0.0003, points.shape)).astype(np.float32)


def ask(**fields: object) -> DetectOptions:
    return DetectOptions.model_validate({"viewpoint": VIEW, "support": TABLE, **fields})


def same(one: Detection, other: Detection) -> bool:
    return len(one.grasps) == len(other.grasps) and all(
        a.score == b.score and np.array_equal(a.T_cloud_hand, b.T_cloud_hand)
        for a, b in zip(one.grasps, other.grasps, strict=True)
    )


@pytest.mark.parametrize("config", [TINY, PLUS, VN], ids=["plain", "plus", "vn"])
def test_grasps_are_executable_poses_ranked_by_score(config: NetworkConfig) -> None:
    found = detector(config).detect(box_on_table(), ask())
    assert len(found.grasps) >= 5
    scores = [grasp.score for grasp in found.grasps]
    assert scores == sorted(scores, reverse=True)
    panda = load_gripper()
    for grasp in found.grasps:
        assert 0.0 <= grasp.score <= 1.0
        turn = grasp.T_cloud_hand[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(
            grasp.T_cloud_tcp, grasp.T_cloud_hand @ panda.T_hand_tcp, atol=1e-6
        )
        np.testing.assert_array_equal(grasp.approach_direction, turn[:, 2])
        assert grasp.approach_direction[2] < 0.1  # not from below
        assert grasp.collision_free
        assert 0.0 < grasp.width <= np.float32(panda.max_opening)
        tips = grasp.T_cloud_hand @ [0, 0, panda.tip_z, 1]
        assert tips[2] > 0.0


def test_seed_decides_and_zero_is_a_seed() -> None:
    tiny, cloud = detector(), box_on_table()
    assert same(tiny.detect(cloud, ask(seed=0)), tiny.detect(cloud, ask(seed=0)))
    assert not same(tiny.detect(cloud, ask(seed=0)), tiny.detect(cloud, ask(seed=1)))


def test_the_order_of_the_points_does_not_matter() -> None:
    tiny, cloud = detector(), box_on_table()
    shuffled = np.random.default_rng(5).permutation(cloud)
    one, other = tiny.detect(cloud, ask()), tiny.detect(shuffled, ask())
    assert one.counts == other.counts
    for a, b in zip(one.grasps, other.grasps, strict=True):
        np.testing.assert_allclose(a.T_cloud_hand, b.T_cloud_hand, atol=1e-4)


def test_counts_never_grow_from_stage_to_stage() -> None:
    counts = detector().detect(box_on_table(), ask(min_score=0.4, top_k=7)).counts
    cloud = ["points", "in_workspace", "above_support", "voxels", "kept", "in_approach_region"]
    hands = [
        "pairs",
        "in_contact_region",
        "candidates",
        "in_direction",
        "clear_of_support",
        "checked",
        "collision_free",
    ]
    ranking = ["scored", "above_min_score", "returned"]
    for stages in (cloud, hands, ranking):
        numbers = [counts[name] for name in stages]
        assert numbers == sorted(numbers, reverse=True)
    assert counts["returned"] <= 7


def test_no_grasp_is_an_answer_that_says_why() -> None:
    nothing = detector().detect(
        box_on_table(), ask(workspace=Workspace(min=(1, 1, 1), max=(2, 2, 2)))
    )
    assert nothing.grasps == []
    assert nothing.counts["in_workspace"] == 0
    assert nothing.counts["returned"] == 0
    assert any("0 points are left" in warning for warning in nothing.warnings)

    apart = np.float32(
        [[0, 0, 0.1], [0.2, 0, 0.1], [0, 0.2, 0.1], [0.2, 0.2, 0.1], [0.1, 0.1, 0.2]]
    )
    alone = detector().detect(apart, ask(num_approach_points=5))
    assert alone.grasps == []
    assert alone.counts["kept"] == 5
    assert alone.counts["pairs"] == alone.counts["approach_points"]  # each alone in its ball
    assert alone.counts["candidates"] == 0
    assert any("see counts" in warning for warning in alone.warnings)

    assert detector().detect(box_on_table(), ask(min_score=1.0)).grasps == []


def test_collision_modes_leave_out_penalise_or_ignore() -> None:
    tiny, cloud = detector(), box_on_table()
    avoid = tiny.detect(cloud, ask(collision="avoid", suppression=None, top_k=2000))
    penalise = tiny.detect(cloud, ask(collision="penalise", suppression=None, top_k=2000))
    ignore = tiny.detect(cloud, ask(collision="ignore", suppression=None, top_k=2000))
    assert all(grasp.collision_free for grasp in avoid.grasps)
    free = [grasp.collision_free for grasp in penalise.grasps]
    worth = [g.score if g.collision_free else g.score / 2 for g in penalise.grasps]
    assert worth == sorted(worth, reverse=True)
    assert not all(free)
    assert sum(free) == len(avoid.grasps)
    scores = [grasp.score for grasp in ignore.grasps]
    assert scores == sorted(scores, reverse=True)
    assert not all(grasp.collision_free for grasp in ignore.grasps)


def test_an_unknown_viewpoint_and_table_still_give_grasps_and_a_warning() -> None:
    found = detector().detect(box_on_table(), DetectOptions())
    assert found.grasps
    assert any("viewpoint" in warning for warning in found.warnings)


def test_candidates_are_bounded_by_the_request() -> None:
    found = detector().detect(box_on_table(), ask(num_candidates=10, collision="penalise"))
    assert found.counts["scored"] == 10


def test_a_bad_cloud_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="NaN"):
        detector().detect(np.full((100, 3), np.nan, np.float32), ask())


def write_weights(folder: Path, name: str) -> None:
    tiny = detector()
    save_checkpoint(folder / f"{name}.safetensors", tiny.network, replace(tiny.metadata, name=name))


def test_a_catalogue_finds_weights_by_their_file_name(tmp_path: Path) -> None:
    write_weights(tmp_path, "mine")
    catalogue = ModelCatalogue.load([tmp_path], default="mine")
    assert "mine" in catalogue.names()
    assert catalogue.get("").metadata.name == "mine"
    assert catalogue.get("mine") is catalogue.get()
    facts = next(facts for facts in catalogue.describe() if facts["name"] == "mine")
    assert facts["default"] is True
    assert len(facts["digest"]) == 64
    catalogue.warm_up()
    with pytest.raises(UnknownModel, match=r"got 'nobody'.*mine"):
        catalogue.get("nobody")


def test_a_catalogue_needs_weights_and_a_default_that_exists(tmp_path: Path) -> None:
    write_weights(tmp_path, "mine")
    with pytest.raises(UnknownModel):
        ModelCatalogue.load([tmp_path], default="other")
    with pytest.raises(InvalidCheckpoint):
        ModelCatalogue({})


def test_debug_returns_the_cloud_and_every_candidate_with_what_became_of_it() -> None:
    options = ask(debug=True, min_score=0.3, top_k=5, num_candidates=200)
    found = detector().detect(box_on_table(), options)
    debug, counts = found.debug, found.counts
    assert debug is not None
    assert len(debug.points) == len(debug.normals) == counts["kept"]
    np.testing.assert_allclose(np.linalg.norm(debug.normals, axis=1), 1.0, atol=1e-5)
    assert len(debug.outcome) == len(debug.score) == len(debug.T_cloud_hand)
    assert len(debug.outcome) == counts["candidates"]
    np.testing.assert_allclose(debug.support_plane, [0, 0, 1, 0], atol=1e-6)
    tally = Counter(debug.outcome)
    assert tally[Outcome.RETURNED] == counts["returned"] == 5
    assert tally[Outcome.SUPPRESSED] == counts["suppressed"]
    assert tally[Outcome.LOW_SCORE] == counts["scored"] - counts["above_min_score"]
    assert tally[Outcome.COLLISION] == counts["checked"] - counts["collision_free"]
    assert tally[Outcome.NOT_SCORED] == counts["collision_free"] - counts["scored"]
    assert tally[Outcome.NOT_CHECKED] == counts["clear_of_support"] - counts["checked"]
    assert tally[Outcome.SUPPORT] == counts["in_direction"] - counts["clear_of_support"]
    assert tally[Outcome.DIRECTION] == counts["candidates"] - counts["in_direction"]
    scored = np.isfinite(debug.score)
    assert scored.sum() == counts["scored"]
    unscored = {Outcome.COLLISION, Outcome.DIRECTION, Outcome.SUPPORT, Outcome.NOT_CHECKED}
    for row, outcome in enumerate(debug.outcome):
        assert not (scored[row] and outcome in unscored)
        assert outcome != Outcome.LOW_SCORE or debug.score[row] < 0.3
    returned = {grasp.T_cloud_hand.tobytes(): grasp for grasp in found.grasps}
    for row in np.flatnonzero([outcome == Outcome.RETURNED for outcome in debug.outcome]):
        grasp = returned[debug.T_cloud_hand[row].tobytes()]
        np.testing.assert_allclose(debug.score[row], grasp.score, atol=1e-6)
        np.testing.assert_array_equal(debug.points[debug.approach_index[row]], grasp.approach_point)
        np.testing.assert_array_equal(debug.points[debug.contact_index[row]], grasp.contact_point)
    assert detector().detect(box_on_table(), ask()).debug is None


def test_debug_tells_of_every_round_of_sampling_and_of_none() -> None:
    wall = {"kind": "box", "min": [-1, -1, -1], "max": [1, 1, 1]}
    options = ask(debug=True, collision={"obstacles": [wall]}, num_approach_points=4)
    blocked = detector().detect(box_on_table(), options)
    assert blocked.grasps == []
    assert blocked.counts["approach_points"] == 16  # four further rounds, and no more
    assert blocked.debug is not None
    assert len(blocked.debug.outcome) == blocked.counts["candidates"]
    assert Counter(blocked.debug.outcome)[Outcome.COLLISION] == blocked.counts["checked"]
    nowhere = ask(
        debug=True,
        approach_region={"include": [{"kind": "sphere", "center": [1, 1, 1], "radius": 0.1}]},
    )
    empty = detector().detect(box_on_table(), nowhere)
    assert empty.debug is not None
    assert empty.debug.outcome == []
    assert empty.counts["in_approach_region"] == 0
    assert any("approach region" in warning for warning in empty.warnings)
    cropped = detector().detect(
        box_on_table(), ask(debug=True, workspace=Workspace(min=(1, 1, 1), max=(2, 2, 2)))
    )
    assert cropped.debug is None


def test_where_every_hand_collides_only_penalise_returns_some_and_marks_them() -> None:
    wall = {"kind": "box", "min": [-1, -1, -1], "max": [1, 1, 1]}
    for mode, returned in (("avoid", False), ("penalise", True), ("ignore", True)):
        options = ask(collision={"mode": mode, "obstacles": [wall]}, num_approach_points=4)
        found = detector().detect(box_on_table(), options)
        assert bool(found.grasps) == returned
        assert not any(grasp.collision_free for grasp in found.grasps)
        assert all(grasp.clearance < 0 for grasp in found.grasps)


def test_a_cloud_with_all_that_can_come_with_it_is_taken() -> None:
    cloud = box_on_table(count=1200)
    organised = np.full((40, 100, 3), np.nan, np.float32)
    organised.reshape(-1, 3)[: len(cloud)] = cloud
    sent = CloudInput(
        organised,
        colors=np.zeros((40, 100, 3), np.uint8),
        segment_ids=np.zeros((40, 100), int),
        view_ids=np.zeros(4000, int),
    )
    assert same(detector().detect(sent, ask()), detector().detect(cloud, ask()))
