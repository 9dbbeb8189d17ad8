"""The choice of an engine, what both must agree on, and sets of objects for them."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.programs import run

from edgegrasp_sim import objects
from edgegrasp_sim.camera import look_at, unproject_to_world
from edgegrasp_sim.engine import SimCamera, World, choose_engine, make_world
from edgegrasp_sim.engine.urdf import parse_obj, read_urdf
from edgegrasp_sim.fixed_parts import OPEN_TABLE
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.scene import load_object
from edgegrasp_sim.sensor import SENSORS, STRUCTURED_LIGHT

CUBE = ObjectModel("cube", Path(__file__).parent / "cube.urdf")  # 0.05 m
CAMERA = SimCamera()
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
    if engine == "mujoco":  # stands in for it
        assert choose_engine(None, "pybullet") == "mujoco"
        with make_world() as world:
            assert world.name == "mujoco"
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ModuleNotFoundError, match=f"{engine} is not .*: pip install {engine}"):
        choose_engine(engine)
    with pytest.raises(ModuleNotFoundError, match="no physics engine is installed"):
        choose_engine()


DRAW_WHERE_MUJOCO_CAME_FIRST = """
import mujoco, numpy
from edgegrasp_sim.engine import SimCamera, make_world
with make_world("mujoco") as world:
    world.add_box((9, 9, 1), (0, 0, 1.5), friction=1)
    print(world.render_depth(numpy.eye(4), SimCamera()).min().round(3))
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
    assert [len(part.faces) for _, part in parse_obj((tmp_path / "two.obj").read_text())] == [3, 3]
    for right, wrong, message in (
        ("two.obj", "two.dae", r"two\.dae is not an OBJ file"),
        ("2 1 1", "2 1", "scale of its mesh is '2 1'; write 3 numbers"),
    ):
        (tmp_path / "shapes.urdf").write_text(SHAPES.replace(right, wrong))
        with pytest.raises(ValueError, match=message):
            read_urdf(tmp_path / "shapes.urdf", 1.0)


def test_both_engines_see_the_same() -> None:
    T_world_camera = look_at(np.array([0.6, 0.3, 0.5]), np.array([0.15, 0.15, 0.05]))
    images = []
    for engine in ("pybullet", "mujoco"):
        pytest.importorskip(engine, reason=f"{engine} is not installed")
        with make_world(engine) as world:
            OPEN_TABLE.add_to(world)
            load_object(world, CUBE, (0.15, 0.15, 0.075), (0.0, 0.0, 0.38, 0.92), 1.0)
            images.append(world.render_depth(T_world_camera, SimCamera()))
    assert (np.abs(images[0] - images[1]) > 2e-4).mean() < 0.002  # some pixels on edges


@pytest.mark.parametrize(("aside", "azimuth"), [(0.5, 0.0), (0.5, 1.0), (0.5, 4.0), (0.0, 0.0)])
def test_a_box_appears_where_it_is(world: World, aside: float, azimuth: float) -> None:
    centre, half = np.array([0.15, 0.12, 0.10]), np.array([0.03, 0.04, 0.05])
    target = np.array([0.15, 0.15, 0.1])
    away = [aside * np.cos(azimuth), aside * np.sin(azimuth), 0.5]  # or straight above
    eye = target + np.array(away)
    world.add_box(2 * half, centre, friction=0.5)
    T_world_camera = look_at(eye, target)
    points = unproject_to_world(world.render_depth(T_world_camera, CAMERA), T_world_camera, CAMERA)
    assert len(points) > 1000
    outside = np.abs(points - centre) - half
    apart = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    assert np.abs(apart + np.minimum(outside.max(axis=1), 0.0)).max() < 1e-4
    # The top is seen from edge to edge, so that no pixel is shifted sideways either.
    top = points[points[:, 2] > centre[2] + half[2] - 1e-4]
    assert top[:, :2].min(axis=0) == pytest.approx(centre[:2] - half[:2], abs=1.5e-3)
    assert top[:, :2].max(axis=0) == pytest.approx(centre[:2] + half[:2], abs=1.5e-3)


FAULTLESS = replace(
    STRUCTURED_LIGHT, baseline=0.0, window=1, fattening=0.0, noise_floor=0.0, noise_growth=0.0,
    warp=0.0, disparity_step=0.0, grazing=180.0, missing=0.0,
)  # fmt: skip


def box_before_wall() -> np.ndarray:
    depth = np.full((240, 320), 1.0)
    depth[80:160, 120:200] = 0.8
    return depth


def seen(sensor, depth: np.ndarray, seed: int = 0) -> np.ndarray:
    return sensor.apply(depth, CAMERA, np.random.default_rng(seed))


def test_a_camera_without_faults_sees_what_is_there_and_nothing_beyond_its_range() -> None:
    depth = box_before_wall()
    depth[:, 300:] = CAMERA.far
    image = seen(FAULTLESS, depth)
    assert np.isnan(image[:, 300:]).all()
    np.testing.assert_allclose(image[:, :300], depth[:, :300], atol=1e-6)


@pytest.mark.parametrize("pixels", [1, 4])
def test_noise_grows_with_the_square_of_the_depth(pixels: int) -> None:
    noisy = replace(FAULTLESS, noise_growth=0.002, noise_pixels=pixels)
    spread = [seen(noisy, np.full((240, 320), depth)).std() for depth in (0.5, 1.0, 1.5)]
    assert spread == pytest.approx([0.0005, 0.002, 0.0045], rel=0.15)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_what_the_projector_does_not_light_is_missing_on_its_other_side(side: float) -> None:
    missing = np.isnan(seen(replace(FAULTLESS, baseline=side * 0.075), box_before_wall()))
    beside = [slice(100, 120), slice(200, 220)]  # to the left of the box, and to the right
    shadow, lit = beside if side > 0 else reversed(beside)
    width = 0.075 * CAMERA.focal_length * (1 / 0.8 - 1)  # pixels
    assert missing[90:150, shadow].sum(axis=1) == pytest.approx(np.full(60, width), abs=2)
    assert not missing[90:150, lit].any()
    assert not missing[:70].any()


@pytest.mark.parametrize("kind", SENSORS)
def test_the_same_seed_gives_the_same_image(kind: str) -> None:
    depth = box_before_wall()
    image = seen(SENSORS[kind], depth)
    np.testing.assert_array_equal(image, seen(SENSORS[kind], depth))
    assert not np.array_equal(image, seen(SENSORS[kind], depth, seed=1), equal_nan=True)
    assert np.nanmedian(np.abs(image - depth)) < 0.005


def extents(world: World, model: ObjectModel, scale: float = 1.0) -> np.ndarray:
    item = load_object(world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), scale)
    found: np.ndarray = np.ptp(item.body.bounds, axis=0)
    item.body.remove()
    return found - (0.006 if world.name == "pybullet" else 0.0)  # its boxes are wider


@pytest.mark.parametrize("scene", [SceneKind.PACKED, SceneKind.PILE])  # others have theirs
def test_builtin_objects_fit_between_the_fingers(world: World, scene: SceneKind) -> None:
    models = ObjectSet.builtin(scene).models
    assert len({model.urdf for model in models}) == len({model.name for model in models}) >= 8
    for model in models:
        extent = np.sort(extents(world, model, 0.8))
        assert extent[0] < 0.075, model.name
        assert extent[2] < 0.25, model.name


def test_folders_are_read_in_order_of_names(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"<scene>/<split>/<name>\.urdf"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)
    for name in ("cup.obj", "cup.stl"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match="several meshes named cup"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)
    folder = tmp_path / "packed" / "train"
    folder.mkdir(parents=True)
    for name in ("b", "a", "c"):
        (folder / f"{name}.urdf").touch()
    (folder / "a_visual.obj").touch()  # beside URDF files, meshes are parts of those
    found = ObjectSet.from_folder(tmp_path, SceneKind.PACKED, "train")
    assert [model.name for model in found.models] == ["a", "b", "c"]
    assert found.name == "packed/train"
    for text, message in (
        ("", "cannot be read"),
        (SHAPES, r"names .*two\.obj, which is not a file"),
        ("<robot/>", "has 0 links"),
    ):
        (folder / "a.urdf").write_text(text)
        with pytest.raises(ValueError, match=rf"a\.urdf {message}"):
            assert found.digest


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring in millimetres, a brick in metres."""
    trimesh = pytest.importorskip("trimesh", reason="the extra `meshes` is not installed")
    pytest.importorskip("coacd", reason="the extra `meshes` is not installed")
    folder = tmp_path_factory.mktemp("meshes")
    ring = trimesh.creation.torus(30.0, 10.0, major_sections=10, minor_sections=6)
    ring.export(folder / "ring.obj")
    trimesh.creation.box((0.1, 0.2, 0.4)).export(folder / "Brick.STL")
    (folder / "notes.txt").write_text("no mesh")
    return folder


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One cache for all tests, so that each mesh is decomposed once."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    return objects.cache_folder()


def test_meshes_of_any_unit_are_scaled_to_the_hand(world: World, meshes: Path, cache: Path) -> None:
    models = ObjectSet.from_folder(meshes, SceneKind.PILE).models
    assert [model.name for model in models] == ["Brick", "ring"]
    brick, ring = (np.sort(extents(world, model)) for model in models)
    np.testing.assert_allclose(brick, objects.LONGEST_SIDE * np.array([0.25, 0.5, 1.0]), atol=1e-3)
    # A ring of six-sided tubes is a little lower than it is thick.
    assert ring[0] == pytest.approx(objects.LONGEST_SIDE / 4, rel=0.15)
    assert max(brick[0], ring[0]) <= objects.SHORTEST_SIDE


def test_prepared_meshes_are_cached_by_content(meshes: Path, cache: Path, tmp_path: Path) -> None:
    urdf = objects.prepare_mesh(meshes / "ring.obj")
    assert urdf.is_relative_to(cache)
    before = urdf.stat().st_mtime_ns
    copy = tmp_path / "other name.obj"
    copy.write_bytes((meshes / "ring.obj").read_bytes())
    assert objects.prepare_mesh(copy) == urdf
    assert urdf.stat().st_mtime_ns == before
    copy.write_bytes((meshes / "ring.obj").read_bytes() + b"\n# changed\n")
    again = objects.prepare_mesh(copy)
    assert again != urdf
    # The same mesh makes the same object, to the byte.
    for file in sorted(urdf.parent.iterdir()):
        assert (again.parent / file.name).read_bytes() == file.read_bytes()
    assert not list(cache.glob(".unfinished*"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("v 0 0 0\n", "contains no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not a solid object"),
        ("v 0 0 0\nv 1 0 1\nv 0 1 1\nf 1 2 3\n", "not a solid object"),
        ("v 0 0 zero\nf 1 2 3\n", "cannot be read"),
    ],
)
def test_a_file_without_a_solid_is_refused(cache, tmp_path, content, message) -> None:
    pytest.importorskip("coacd", reason="the extra `meshes` is not installed")
    (tmp_path / "shape.obj").write_text(content)
    with pytest.raises(ValueError, match=rf"shape\.obj.*({message})"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)


@pytest.mark.parametrize("package", ["coacd", "trimesh"])
def test_a_missing_package_is_named(meshes, cache, package, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=rf"{package} is not .*edgegrasp\[meshes\]"):
        ObjectSet.from_folder(meshes, SceneKind.PILE)
