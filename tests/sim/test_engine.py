"""The choice of an engine, and what both must agree on."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.programs import run

from edgegrasp_sim.camera import look_at
from edgegrasp_sim.engine import Intrinsics, choose_engine, make_world
from edgegrasp_sim.engine.urdf import read_obj, read_urdf
from edgegrasp_sim.objects import ObjectModel
from edgegrasp_sim.scene import load_object
from edgegrasp_sim.surroundings import OPEN_TABLE

CUBE = ObjectModel("cube", Path(__file__).parent / "cube.urdf")  # 0.05 m
SHAPES = """<robot name="shapes"><link name="link">
<inertial><origin xyz="0 0 0.01"/><mass value="1"/></inertial>
<visual><geometry><sphere radius="0.03"/></geometry></visual>
<collision><origin xyz="0.1 0 0"/><geometry><cylinder radius="0.02" length="0.1"/></geometry>
</collision>
<collision><geometry><mesh filename="two.obj" scale="2 1 1"/></geometry></collision>
</link></robot>"""
TETRAHEDRON = (
    "v 0 0 0\nv {0} 0 0\nv 0 {0} 0\nv 0 0 {0}\nf -4/1/1 -3//2 -2\nf -4 -3 -1\nf -4 -2 -1\n"
)


def test_the_engine_asked_for_comes_first_then_the_protocol_s_then_what_is_there(
    engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert choose_engine(engine) == choose_engine(None, engine) == engine
    with pytest.raises(ValueError, match="engine is 'bullet'; choose one of pybullet, mujoco"):
        choose_engine("bullet")
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModuleNotFoundError, match=f"{engine} is not .*: pip install {engine}"):
        choose_engine(engine)
    with pytest.raises(ModuleNotFoundError, match="no physics engine is installed"):
        choose_engine()


def test_mujoco_stands_in_for_pybullet(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    monkeypatch.setitem(sys.modules, "pybullet", None)
    assert choose_engine(None, "pybullet") == "mujoco"
    with make_world() as world:
        assert world.name == "mujoco"


DRAW_WHERE_MUJOCO_CAME_FIRST = """
import mujoco, numpy
from edgegrasp_sim.engine import Intrinsics, make_world
with make_world("mujoco") as world:
    world.add_box((9, 9, 1), (0, 0, 1.5), friction=1)
    print(world.render_depth(numpy.eye(4), Intrinsics()).min().round(3))
"""


def test_mujoco_draws_where_it_was_imported_before() -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    command = [sys.executable, "-c", DRAW_WHERE_MUJOCO_CAME_FIRST]
    usual = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    assert run(*command, env=usual).stdout == "1.0\n"


def test_shapes_are_read_as_they_are_described(tmp_path: Path) -> None:
    (tmp_path / "two.obj").write_text("".join(f"o {k}\n" + TETRAHEDRON.format(k) for k in (1, 2)))
    (tmp_path / "shapes.urdf").write_text(SHAPES)
    shape = read_urdf(tmp_path / "shapes.urdf", 0.5)
    assert shape.centre == pytest.approx((0.0, 0.0, 0.005))
    (ball,) = shape.visible
    assert np.linalg.norm(ball.points + shape.centre, axis=1) == pytest.approx(0.015)
    extents = [np.ptp(hull.points, axis=0) for hull in shape.hulls]
    np.testing.assert_allclose(extents[0], (0.02, 0.02, 0.05), atol=1e-9)
    np.testing.assert_allclose(extents[1:], [(1.0, 0.5, 0.5), (2.0, 1.0, 1.0)])
    assert [len(part.faces) for _, part in read_obj(tmp_path / "two.obj")] == [3, 3]
    (tmp_path / "shapes.urdf").write_text(SHAPES.replace("two.obj", "two.dae"))
    with pytest.raises(ValueError, match=r"two\.dae is not an OBJ file"):
        read_urdf(tmp_path / "shapes.urdf", 1.0)


def test_both_engines_see_the_same() -> None:
    for package in ("pybullet", "mujoco"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    T_world_camera = look_at(np.array([0.6, 0.3, 0.5]), np.array([0.15, 0.15, 0.05]))
    images = []
    for engine in ("pybullet", "mujoco"):
        with make_world(engine) as world:
            OPEN_TABLE.add_to(world)
            load_object(world, CUBE, (0.15, 0.15, 0.075), (0.0, 0.0, 0.38, 0.92), 1.0)
            images.append(world.render_depth(T_world_camera, Intrinsics()))
    differs = np.abs(images[0] - images[1]) > 2e-4
    assert differs.mean() < 0.002  # some pixels on edges
