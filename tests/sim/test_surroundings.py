from pathlib import Path

import numpy as np
import pytest

from edgegrasp_sim.camera import look_at
from edgegrasp_sim.hand import FINGERTIP, FailureCause
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement
from edgegrasp_sim.surroundings import MIDDLE, OPEN_TABLE, TABLE_HEIGHT, Box, Surroundings

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


def test_a_full_bin_hides_its_floor(simulation: ClutterSimulation) -> None:
    most = 40
    number = simulation.reset(SceneKind.FULL_BIN, np.random.default_rng(2), most, (1.6, 1.6))
    low, high = np.asarray(simulation.surroundings.workspace)
    cloud = seen_from_above(simulation)
    inside = cloud[((cloud[:, :2] > low[:2]) & (cloud[:, :2] < high[:2])).all(axis=1)]
    assert (inside[:, 2] > TABLE_HEIGHT + 0.003).mean() > 0.75
    assert number < most  # no more than that takes
    assert simulation.reset(SceneKind.FULL_BIN, np.random.default_rng(2), 3) <= 3
