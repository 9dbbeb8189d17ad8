"""What planners ask for and take, by the protocol."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_cli.planners.baselines import (
    PaperCandidates,
    clean_cloud,
    paper_grasps,
)
from edgegrasp_cli.planners.choice import PlannerChoice, named_planner, open_planner
from edgegrasp_cli.planners.detection import request_options, select_grasp
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_model.scene.cloud import Cloud
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.hand import FINGERTIP
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.poses import translation
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PlannedGrasp, RoundDriver

PAPER, ROBOT = load_protocol("edgegrasp").planning, load_protocol("robot").planning
MEMORY = load_protocol("edgegrasp-memory").planning
NONE_FAILED = np.empty((0, 4, 4))


@dataclass(frozen=True)
class Found:
    score: float
    height: float
    width: float = 0.05

    @property
    def T_cloud_tcp(self) -> np.ndarray:  # noqa: N802
        T = np.eye(4, dtype=np.float32)
        T[2, 3] = self.height
        return T

    @property
    def T_cloud_hand(self) -> np.ndarray:  # noqa: N802
        return self.T_cloud_tcp @ translation(0.0, 0.0, -0.1).astype(np.float32)


def seen_under(name: str) -> Observation:
    with ClutterSimulation() as simulation:
        driver = RoundDriver(simulation, SceneKind.PACKED, load_protocol(name), seed=0, index=0)
        return driver.look()


def test_the_robot_protocol_takes_the_highest_of_the_good() -> None:
    best, higher, bad = Found(0.99, 0.1), Found(0.92, 0.2), Found(0.5, 0.3)
    assert select_grasp([best, higher, bad], PAPER, NONE_FAILED) is best
    assert select_grasp([best, higher, bad], ROBOT, NONE_FAILED) is higher
    assert select_grasp([bad, replace(bad, score=0.4, height=0.9)], ROBOT, NONE_FAILED) is bad
    assert select_grasp([], ROBOT, NONE_FAILED) is None


def test_with_a_memory_other_objects_and_other_grips_come_first() -> None:
    best, beside, away, far_worse = (
        Found(0.99, 0.1),
        Found(0.98, 0.13),
        Found(0.85, 0.2),
        Found(0.4, 0.3),
    )
    every = [best, beside, away, far_worse]
    failed = np.stack([best.T_cloud_hand])
    assert select_grasp(every, MEMORY, NONE_FAILED) is best
    assert select_grasp(every, PAPER, failed) is best
    assert select_grasp(every, MEMORY, failed) is away  # 0.85 against 0.8 times 0.98
    assert select_grasp([best, beside, far_worse], MEMORY, failed) is beside
    assert (
        select_grasp([best, far_worse], MEMORY, failed) is best
    )  # 0.8 times 0.6 of it is still more
    twice = np.stack([best.T_cloud_hand, beside.T_cloud_hand])
    assert select_grasp([best, beside, far_worse], MEMORY, twice) is far_worse
    turned = failed @ np.diag([-1.0, -1.0, 1.0, 1.0])  # fingers swapped: the same grip
    assert select_grasp([best, replace(beside, score=0.6)], MEMORY, turned) is not best
    assert select_grasp([], MEMORY, failed) is None


def test_requests_follow_the_protocol() -> None:
    options = request_options(seen_under("edgegrasp"), 7, PAPER, {"num_candidates": 100})
    assert options["seed"] == 7
    assert (options["num_approach_points"], options["num_candidates"]) == (64, 100)
    assert options["support"]["offset"] == 0.05
    assert len(options["viewpoint"]) == 3
    assert request_options(seen_under("robot"), 0, ROBOT, {})["support"] == {"kind": "ransac"}
    giga = request_options(seen_under("giga"), 0, load_protocol("giga").planning, {})
    assert giga["support"]["offset"] == 0.05
    assert giga["support"]["max_depth_error"] == 0.12
    assert giga["workspace"]["min"][2] > 0.05
    six = request_options(seen_under("vgn"), 0, load_protocol("vgn").planning, {})
    assert np.shape(six["viewpoint"]) == (6, 3)


GOLDEN = ("packed_00", "packed_03", "pile_04", "pile_07", "pile_09")
MOST_KEPT = 1500  # candidates that the reference kept of a scene


@pytest.mark.parametrize("name", GOLDEN)
def test_random_candidates_and_their_clouds_are_the_reference_s(shared_dir, name) -> None:
    golden = np.load(shared_dir / "reference" / "golden" / f"{name}.npz")
    edges, kept = golden["ball_edges"].astype(np.int64), golden["edge_rows"]
    theirs = Cloud(golden["points"], golden["normals"])
    pair, poses = paper_grasps(theirs, edges[:, 0], edges[:, 1], 0.05)
    assert set(kept) <= set(pair)
    if len(kept) < MOST_KEPT:
        assert set(pair) == set(kept)
    found = poses[np.searchsorted(pair, kept)] @ translation(0.0, 0.0, 0.04)
    np.testing.assert_allclose(found, golden["T_world_handcom"], atol=2e-6)

    cloud = clean_cloud(golden["dense_cloud"], 0.0045)
    assert cloud is not None
    assert len(cloud.points) == len(theirs.points)
    order, golden_order = (np.lexsort(np.round(p, 5).T) for p in (cloud.points, theirs.points))
    np.testing.assert_allclose(cloud.points[order], theirs.points[golden_order], atol=1e-6)
    dots = np.einsum("nd,nd->n", cloud.normals[order], theirs.normals[golden_order])
    lengths = np.linalg.norm(cloud.normals[order], axis=1)
    alike = np.abs(dots) / lengths / np.linalg.norm(theirs.normals[golden_order], axis=1)
    assert np.quantile(alike, 0.01) > 0.999  # of either sign
    assert alike.min() > 0.9


def test_random_candidates_follow_the_seed_and_stay_above_the_table() -> None:
    observation = seen_under("edgegrasp")
    sampler = PaperCandidates(64, 4000, 0.004)
    poses = sampler(observation, np.random.default_rng(0))
    assert 0 < len(poses) <= 4000
    assert (poses[:, 2, 2] < 0.1 + 1e-5).all()  # the hand does not come from below
    tips = poses[:, 2, 3] + FINGERTIP * poses[:, 2, 2]
    assert (tips > observation.table_height).all()
    assert np.array_equal(poses, sampler(observation, np.random.default_rng(0)))
    assert not np.array_equal(poses, sampler(observation, np.random.default_rng(1)))
    few = replace(observation, cloud=observation.cloud[:5], view_ids=observation.view_ids[:5])
    assert len(sampler(few, np.random.default_rng(0))) == 0


FEW = {"num_approach_points": 8, "num_candidates": 100}


def planned(**changes: object) -> PlannedGrasp:
    choice = PlannerChoice("in-process", options=FEW, **changes)
    with open_planner(choice, PAPER) as made:
        grasp = made.make()(seen_under("edgegrasp"), 3)
    assert grasp is not None
    return grasp


def test_normals_can_be_flipped_and_voxels_changed_in_process() -> None:
    plain = planned()
    # So few that none is: the way over given normals changes nothing.
    unchanged = planned(flipped_normals=1e-9)
    np.testing.assert_allclose(unchanged.T_world_hand, plain.T_world_hand, atol=1e-5)
    assert unchanged.score == pytest.approx(plain.score, abs=1e-4)
    assert abs(planned(flipped_normals=0.5).score - plain.score) > 1e-3
    assert not np.allclose(planned(voxel_size=0.006).T_world_hand, plain.T_world_hand, atol=1e-3)
    with (
        pytest.raises(ValueError, match="need in-process"),
        open_planner(PlannerChoice("edge-sample", voxel_size=0.006), PAPER),
    ):
        pass


def test_a_model_may_be_a_file_of_weights(tmp_path: Path) -> None:
    ablation = tmp_path / "no-augmentation.safetensors"
    ablation.write_bytes((WEIGHTS_FOLDER / "edgegrasp-plus.safetensors").read_bytes())
    with open_planner(PlannerChoice("in-process", str(ablation)), PAPER) as made:
        assert len(made.facts["digest"]) == 64
    assert planned(model=str(ablation)).score == planned().score
    missing = PlannerChoice("in-process", str(tmp_path / "none.safetensors"))
    with pytest.raises(ValueError, match="no such file"), open_planner(missing, PAPER):
        pass
    elsewhere = PlannerChoice("server", str(ablation), server="127.0.0.1:1")
    with pytest.raises(ValueError, match="server's own weights"), open_planner(elsewhere, PAPER):
        pass


def test_another_package_may_name_its_planner(tmp_path, monkeypatch) -> None:
    about = tmp_path / "their_package-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(
        "[edgegrasp.planners]\ntheirs = their_package:Planner\nbroken = their_package:Missing\n"
    )
    (tmp_path / "their_package.py").write_text(
        "class Planner:\n    def __call__(self, observation, seed): return None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert type(named_planner("theirs")).__module__ == "their_package"
    with pytest.raises(ValueError, match="'broken' cannot be loaded"):
        named_planner("broken")
    with pytest.raises(ValueError, match="oracle, oracle-own, broken, theirs, or module:callable"):
        named_planner("nobody")


@pytest.mark.parametrize("name", ["guess", "json:", ":loads", "json:no_such", "math:pi"])
def test_a_wrong_planner_is_told(name: str) -> None:
    with pytest.raises(ValueError, match=f"planner .*{name}"):
        named_planner(name)
