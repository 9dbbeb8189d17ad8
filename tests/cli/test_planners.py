"""What planners ask for and take, by the protocol."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from edgegrasp_cli.planners import NamedPlanner
from edgegrasp_cli.planners.edge_sample import CandidateSampler
from edgegrasp_cli.planners.oracle import OraclePlanner
from edgegrasp_cli.planners.requests import choose, request_options
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation, Observation
from edgegrasp_sim.trials import RoundDriver

PAPER, ROBOT = load_protocol("edgegrasp").planning, load_protocol("robot").planning


@dataclass(frozen=True)
class Found:
    score: float
    height: float

    @property
    def T_cloud_tcp(self) -> np.ndarray:  # noqa: N802
        T = np.eye(4, dtype=np.float32)
        T[2, 3] = self.height
        return T


def seen_under(name: str) -> Observation:
    with ClutterSimulation() as simulation:
        driver = RoundDriver(simulation, SceneKind.PACKED, load_protocol(name), seed=0, index=0)
        return driver.look()


def test_the_robot_protocol_takes_the_highest_of_the_good() -> None:
    best, higher, bad = Found(0.99, 0.1), Found(0.92, 0.2), Found(0.5, 0.3)
    assert choose([best, higher, bad], PAPER) is best
    assert choose([best, higher, bad], ROBOT) is higher
    assert choose([bad, replace(bad, score=0.4, height=0.9)], ROBOT) is bad
    assert choose([], ROBOT) is None


def test_requests_follow_the_protocol() -> None:
    options = request_options(seen_under("edgegrasp"), 7, PAPER, {"num_candidates": 100})
    assert options["seed"] == 7
    assert (options["num_approach_points"], options["num_candidates"]) == (64, 100)
    assert options["support"]["offset"] == 0.05
    assert len(options["viewpoint"]) == 3
    assert request_options(seen_under("robot"), 0, ROBOT, {})["support"] == {"kind": "ransac"}
    six = request_options(seen_under("vgn"), 0, load_protocol("vgn").planning, {})
    assert np.shape(six["viewpoint"]) == (6, 3)


def test_random_candidates_keep_the_reference_s_constraints() -> None:
    observation = seen_under("edgegrasp")
    sampler = CandidateSampler(64, 4000, 0.004)
    poses = sampler(observation, np.random.default_rng(0))
    assert 0 < len(poses) <= 4000
    assert (poses[:, 2, 2] < 0.1).all()  # the hand does not come from below
    tips = poses[:, 2, 3] + 0.1122 * poses[:, 2, 2]
    assert (tips > observation.table_height).all()
    again = sampler(observation, np.random.default_rng(0))
    assert np.array_equal(poses, again)
    assert (
        len(
            sampler(
                replace(
                    observation, cloud=observation.cloud[:5], view_ids=observation.view_ids[:5]
                ),
                np.random.default_rng(0),
            )
        )
        == 0
    )


def test_an_oracle_without_a_scene_says_so() -> None:
    oracle = OraclePlanner(CandidateSampler(64, 4000, 0.004))
    with pytest.raises(RuntimeError, match="use_trial"):
        oracle(seen_under("edgegrasp"), 0)


@pytest.mark.parametrize("name", ["guess", "json:", ":loads", "json:no_such", "math:pi"])
def test_a_wrong_planner_is_told(name: str) -> None:
    with pytest.raises(ValueError, match=f"planner .*{name}"):
        NamedPlanner(name)()
