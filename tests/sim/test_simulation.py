import json
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_model.gripper import gripper_fields, gripper_names, load_gripper
from edgegrasp_sim.camera import CAMERA, look_at
from edgegrasp_sim.engine import World
from edgegrasp_sim.hand import CENTRE, FINGERTIP
from edgegrasp_sim.objects import ObjectModel, ObjectSet, Prism, SceneKind, write_object
from edgegrasp_sim.poses import translation
from edgegrasp_sim.scene import load_object
from edgegrasp_sim.simulation import PAINTS, ClutterSimulation, ObjectPlacement
from edgegrasp_sim.surroundings import OPEN_TABLE, TABLE_HEIGHT, WORKSPACE

CUBE = Path(__file__).parent / "cube.urdf"  # 0.05 m
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
FRONT = look_at(np.array([0.6, 0.15, 0.6]), np.array([0.15, 0.15, 0.05]))  # T_world_camera
# The reference agrees with itself in 92 to 100 % of packed and 85 to 95 % of pile labels.
# MuJoCo differs where a hand collides; half of the grasps do.
LEAST_AGREEMENT = {
    ("pybullet", SceneKind.PACKED): 0.90,
    ("pybullet", SceneKind.PILE): 0.82,
    ("mujoco", SceneKind.PACKED): 0.75,
    ("mujoco", SceneKind.PILE): 0.75,
}


def cube_at(x: float, y: float, z: float = 0.075) -> ObjectPlacement:
    return ObjectPlacement(CUBE, 1.0, (x, y, z), UPRIGHT)


def top_down(x: float, y: float, tip: float) -> np.ndarray:
    """A hand that looks straight down with its fingertips at (x, y, tip), closing along y."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (x, y, tip + FINGERTIP)
    return T


def grasps_near(simulation: ClutterSimulation, number: int) -> list[np.ndarray]:
    """So many grasps near each object, from above."""
    rng = np.random.default_rng(0)
    return [
        top_down(x + rng.normal(0, 0.01), y + rng.normal(0, 0.01), max(z - 0.01, 0.055))
        for x, y, z in (item.position for item in simulation.placements)
        for _ in range(number)
    ]


def test_a_grasp_that_holds_nothing_says_so_and_moves_nothing(simulation) -> None:
    simulation.reset_from_poses([cube_at(0.15, 0.15)])
    before = simulation.placements
    result = simulation.try_grasp(top_down(0.15, 0.15, 0.15))  # in the air
    assert not result.success
    assert result.opening < 0.008
    assert result.held is None
    assert not simulation.try_grasp(top_down(0.15, 0.25, 0.06)).success  # beside the cube
    assert simulation.placements == before


@pytest.mark.parametrize("name", gripper_names())
def test_every_gripper_lifts_a_cube_between_its_pads(engine: str, name: str) -> None:
    gripper = load_gripper(name)
    T_world_hand = top_down(0.15, 0.15, 0.075 - FINGERTIP + gripper.contact_z_at(0.05))
    with ClutterSimulation(engine=engine, gripper=gripper_fields(name)) as simulation:
        simulation.reset_from_poses([cube_at(0.15, 0.15)])
        result = simulation.try_grasp(T_world_hand, shake=True)
    assert (result.success, result.held_after_shaking) == (True, True)
    assert result.target is result.held
    assert result.opening == pytest.approx(0.05, abs=1e-3)


def test_fingers_that_swing_reach_what_others_miss(engine: str) -> None:
    fields = gripper_fields("robotiq-2f-85")
    above = top_down(0.15, 0.15, 0.105 - FINGERTIP + fields["tip_z"])  # 5 mm over the cube
    held = []
    for swing in (fields["swing"], None):
        with ClutterSimulation(engine=engine, gripper=fields | {"swing": swing}) as simulation:
            simulation.reset_from_poses([cube_at(0.15, 0.15)])
            held.append(simulation.try_grasp(above).success)
    assert held == [True, False]


def test_what_is_wider_than_the_hand_opens_is_counted_and_not_held(engine: str) -> None:
    fields = gripper_fields("wsg-50")
    T_world_hand = top_down(0.15, 0.15, 0.075 - FINGERTIP + fields["contact_z"])
    for opening, wide in ((0.06, 0), (0.045, 1)):
        narrow = fields | {"max_opening": opening}
        with ClutterSimulation(engine=engine, gripper=narrow) as simulation:
            simulation.reset_from_poses([cube_at(0.15, 0.15)])
            assert len(simulation.too_wide) == wide
            assert simulation.try_grasp(T_world_hand).success is not bool(wide)


def test_an_object_pressed_into_the_table_comes_out_on_top(world: World) -> None:
    OPEN_TABLE.add_to(world)
    cube = load_object(world, ObjectModel("cube", CUBE), (0.15, 0.15, 0.035), UPRIGHT, 1.0)
    world.step(400)
    assert cube.body.position[2] == pytest.approx(TABLE_HEIGHT + 0.025, abs=0.002)


def test_thin_objects_that_are_dropped_stay_on_the_table(engine: str, tmp_path: Path) -> None:
    shapes = Prism(4, (0.09, 0.008, 0.008)), Prism(6, (0.10, 0.014, 0.014), axis=0)
    for number, shape in enumerate(shapes):
        write_object(f"stick-{number}", shape.obj(), tmp_path)
    sticks = ObjectSet.from_folder(tmp_path, SceneKind.PILE)
    with ClutterSimulation({SceneKind.PILE: sticks}, engine=engine) as simulation:
        left = [
            simulation.reset(SceneKind.PILE, np.random.default_rng(seed), 5) for seed in range(2)
        ]
    assert sum(left) >= 6  # of 10; some roll away


def test_executed_grasp_removes_the_object(simulation: ClutterSimulation) -> None:
    simulation.reset_from_poses([cube_at(0.10, 0.15), cube_at(0.20, 0.15)])
    grasp = top_down(0.10, 0.15, 0.06)
    assert simulation.try_grasp(grasp).success
    assert simulation.num_objects == 2
    assert simulation.execute_grasp(grasp).success
    assert simulation.num_objects == 1
    assert simulation.placements[0].position == pytest.approx((0.20, 0.15, 0.075), abs=2e-3)
    assert not simulation.execute_grasp(grasp).success


def test_an_object_outside_the_workspace_is_removed(simulation: ClutterSimulation) -> None:
    simulation.reset_from_poses([cube_at(0.15, 0.15), cube_at(0.35, 0.15)])
    simulation.execute_grasp(top_down(0.05, 0.05, 0.2))
    assert [round(item.position[0], 2) for item in simulation.placements] == [0.15]


def test_outcomes_do_not_depend_on_what_was_tried_before(simulation: ClutterSimulation) -> None:
    simulation.reset("pile", np.random.default_rng(3))
    grasps = grasps_near(simulation, 2)
    forward = [simulation.try_grasp(grasp).opening for grasp in grasps]
    backward = [simulation.try_grasp(grasp).opening for grasp in reversed(grasps)]
    assert forward == backward[::-1]
    last = simulation.try_grasp(grasps[0], to_the_end=True)
    assert simulation.execute_grasp(grasps[0]).opening == last.opening


def test_a_try_that_stops_early_saves_steps_and_comes_to_the_same(simulation, monkeypatch) -> None:
    simulation.reset("pile", np.random.default_rng(5))
    steps, step = 0, type(simulation.world).step

    def count(world: World, more: int = 1) -> None:
        nonlocal steps
        steps += more
        step(world, more)

    grasps = grasps_near(simulation, 3)
    monkeypatch.setattr(type(simulation.world), "step", count)
    whole = [simulation.try_grasp(grasp, to_the_end=True).success for grasp in grasps]
    whole_steps, steps = steps, 0
    early = [simulation.try_grasp(grasp).success for grasp in grasps]
    assert any(whole)
    assert not all(whole)
    assert np.mean(np.equal(whole, early)) >= 0.95
    assert steps < 0.75 * whole_steps


@pytest.mark.parametrize("scene", [SceneKind.PACKED, SceneKind.BIN, SceneKind.SHELF])
def test_equal_seeds_make_equal_scenes(engine: str, scene: SceneKind) -> None:
    def run(simulation: ClutterSimulation, seed: int) -> tuple[object, np.ndarray]:
        simulation.reset(scene, np.random.default_rng(seed), 3)
        x, y, z = simulation.placements[0].position
        simulation.execute_grasp(top_down(x, y, max(z - 0.01, 0.055)))
        cloud = simulation.observe_from([FRONT], np.random.default_rng(2)).cloud
        return simulation.placements, cloud

    with ClutterSimulation(engine=engine) as first, ClutterSimulation(engine=engine) as second:
        run(first, 8)
        placements, cloud = run(first, 0)
        again, cloud_again = run(second, 0)
    assert placements == again
    assert np.array_equal(cloud, cloud_again)


def test_observation_holds_the_objects_and_not_the_table(simulation: ClutterSimulation) -> None:
    simulation.reset_from_poses([cube_at(0.15, 0.15)])
    seen = simulation.observe_from([FRONT], np.random.default_rng(0), noise_std=0.0)
    assert seen.cloud.dtype == np.float32
    assert (seen.cloud >= np.float32(WORKSPACE[0])).all()
    assert seen.cloud.max(axis=0) == pytest.approx((0.175, 0.175, 0.1), abs=2e-3)
    assert seen.cloud[:, 1].min() == pytest.approx(0.125, abs=2e-3)
    assert seen.camera_position == pytest.approx((0.6, 0.15, 0.6))
    assert seen.table_height == 0.05
    assert seen.workspace.shape == (2, 3)


def test_an_observation_holds_the_table_where_it_may(simulation: ClutterSimulation) -> None:
    simulation.reset_from_poses([cube_at(0.15, 0.15)])
    known, seen = (
        simulation.observe_from([FRONT], np.random.default_rng(0), noise_std=0.0, table=table)
        for table in ("known", "seen")
    )
    level = [np.abs(each.cloud[:, 2] - TABLE_HEIGHT) < 1e-3 for each in (known, seen)]
    assert [bool(rows.any()) for rows in level] == [False, True]
    np.testing.assert_array_equal(known.workspace, seen.workspace)
    assert seen.cloud[:, :2].min() < known.workspace[0, 0] - 0.05  # what wrong depths move out


def test_a_colour_image_shows_every_object_in_a_paint_of_its_own(simulation) -> None:
    placed = simulation.reset("packed", np.random.default_rng(0), num_objects=4)
    pose = look_at(np.array([0.15, -0.3, 0.5]), np.array([0.15, 0.15, 0.08]))
    image = simulation.color_image(pose)
    assert image.shape == (CAMERA.height, CAMERA.width, 3)
    hues = image / np.maximum(image.sum(axis=2, keepdims=True), 1)
    for paint in PAINTS[:placed]:
        like = np.abs(hues - paint / paint.sum()).max(axis=2) < 0.02
        assert like.sum() > 150


def test_wrong_use_is_refused(simulation: ClutterSimulation) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="scene is 'heap'; choose one of packed, pile"):
        simulation.reset("heap", rng)
    with pytest.raises(ValueError, match="num_objects is 0"):
        simulation.reset("pile", rng, 0)
    with pytest.raises(FileNotFoundError, match="no object file"):
        simulation.reset_from_poses([ObjectPlacement(Path("gone.urdf"), 1.0, (0, 0, 0), UPRIGHT)])
    simulation.reset_from_poses([cube_at(0.15, 0.15)])
    with pytest.raises(ValueError, match="T_world_hand is not a rigid transform"):
        simulation.try_grasp(np.zeros((4, 4)))
    with ClutterSimulation({}) as empty:
        with pytest.raises(RuntimeError, match="call reset"):
            empty.try_grasp(np.eye(4))
        with pytest.raises(ValueError, match="no object set"):
            empty.reset("pile", rng)


@pytest.mark.parametrize(
    ("kind", "to_the_end"), [(SceneKind.PACKED, True), (SceneKind.PILE, False)]
)
def test_outcomes_agree_with_the_reference_simulator(shared_dir, engine, kind, to_the_end) -> None:
    recorded = shared_dir / "reference" / "grasp_outcomes" / f"{kind}.json"
    agreed = []
    with ClutterSimulation(engine=engine) as simulation:
        for scene in json.loads(recorded.read_text())["scenes"]:
            simulation.reset_from_poses(
                [
                    ObjectPlacement(
                        shared_dir / "objects" / item["urdf"],
                        item["scale"],
                        item["position"],
                        item["quaternion_xyzw"],
                    )
                    for item in scene["objects"]
                ]
            )
            poses = np.asarray(scene["T_world_handcom"])[:20] @ translation(0.0, 0.0, -CENTRE)
            held = [simulation.try_grasp(pose, to_the_end=to_the_end).success for pose in poses]
            agreed += np.equal(held, scene["success"][:20]).tolist()
    assert len(agreed) == 80
    assert np.mean(agreed) >= LEAST_AGREEMENT[engine, kind]
