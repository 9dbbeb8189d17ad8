from pathlib import Path

import numpy as np
import pytest

from edgegrasp_sim.camera import look_at
from edgegrasp_sim.hand import FINGERTIP, FailureCause
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement
from edgegrasp_sim.surroundings import (
    MIDDLE,
    OPEN_TABLE,
    TABLE_HEIGHT,
    Box,
    Surroundings,
    random_shelf,
    random_table,
)

ABOVE = look_at(np.array([MIDDLE, MIDDLE, 0.9]), np.array([MIDDLE, MIDDLE, 0.1]))  # T_world_camera


def seen_from_above(simulation: ClutterSimulation) -> np.ndarray:
    rng = np.random.default_rng(0)
    return simulation.observe_from([ABOVE], rng, noise_std=0.0, table="around").cloud


@pytest.mark.parametrize("kind", [SceneKind.BIN, SceneKind.TABLE, SceneKind.SHELF])
def test_objects_rest_where_objects_are(simulation: ClutterSimulation, kind: SceneKind) -> None:
    assert simulation.reset(kind, np.random.default_rng(3), 6) >= 3
    low, high = np.asarray(simulation.surroundings.workspace)
    middles = np.array([item.position for item in simulation.placements])
    low[2] = TABLE_HEIGHT  # the workspace begins a little higher
    assert ((middles > low) & (middles < high)).all()
    simulation.world.step(80)
    after = np.array([item.position for item in simulation.placements])
    resting = np.linalg.norm(after - middles, axis=1) < 0.005
    assert resting.mean() >= 0.5  # round ones roll on a while


def test_a_hand_that_hits_a_large_thing_fails_and_does_not_move_it(engine: str) -> None:
    carton = Box((0.1, 0.2, 0.15), (MIDDLE, MIDDLE, TABLE_HEIGHT + 0.075), yaw=0.3)
    around = Surroundings((*OPEN_TABLE.boxes, carton), OPEN_TABLE.workspace, OPEN_TABLE.bounds)
    T_world_hand = np.diag([1.0, -1.0, -1.0, 1.0])
    T_world_hand[:3, 3] = (MIDDLE, MIDDLE, 0.17 + FINGERTIP)  # 3 cm deep in it
    urdf = Path(__file__).parent / "cube.urdf"
    cube = ObjectPlacement(urdf, 1.0, (0.03, 0.03, 0.075), (0, 0, 0, 1))
    with ClutterSimulation(engine=engine) as simulation:
        simulation.reset_from_poses([cube], around)
        before = seen_from_above(simulation)
        result = simulation.execute_grasp(T_world_hand)
        assert result.cause is FailureCause.APPROACH_COLLISION
        np.testing.assert_allclose(seen_from_above(simulation), before, atol=0.001)
        assert before[:, 2].max() == pytest.approx(TABLE_HEIGHT + 0.15, abs=1e-3)


def test_a_table_has_an_edge_a_floor_below_and_larger_things(simulation) -> None:
    edges = 0
    for seed in range(4):
        around = random_table(np.random.default_rng(seed))
        assert 1 <= sum(box.obstacle for box in around.boxes) <= 3
        simulation.reset_from_poses([], around)
        height = seen_from_above(simulation)[:, 2]
        assert (np.abs(height - TABLE_HEIGHT) < 0.002).mean() > 0.1
        edges += bool((height < TABLE_HEIGHT - 0.3).any())
    assert edges > 0


def test_a_full_bin_hides_its_floor(simulation: ClutterSimulation) -> None:
    most = 40
    number = simulation.reset(SceneKind.FULL_BIN, np.random.default_rng(2), most, (1.6, 1.6))
    low, high = np.asarray(simulation.surroundings.workspace)
    cloud = seen_from_above(simulation)
    inside = cloud[((cloud[:, :2] > low[:2]) & (cloud[:, :2] < high[:2])).all(axis=1)]
    assert (inside[:, 2] > TABLE_HEIGHT + 0.003).mean() > 0.75
    assert number < most  # no more than that takes
    assert simulation.reset(SceneKind.FULL_BIN, np.random.default_rng(2), 3) <= 3


def test_a_shelf_is_open_to_the_front_alone(simulation: ClutterSimulation) -> None:
    for seed in range(3):
        around = random_shelf(np.random.default_rng(seed))
        simulation.reset_from_poses([], around)
        low, high = np.asarray(around.workspace)
        middle = (low + high) / 2
        ways = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0]])
        ends = middle + ways * (high - low)
        hits = simulation.world.first_hits(np.repeat(middle[None], 6, axis=0), ends)
        assert min(hits[:5]) >= 0
        assert len(set(hits[:5])) == 5
        assert hits[5] == -1
        (eye,) = load_protocol("shelf").camera.view_range().sample(np.random.default_rng(seed))
        assert eye[1, 3] < low[1]  # before it
        assert eye[2, 3] > TABLE_HEIGHT
