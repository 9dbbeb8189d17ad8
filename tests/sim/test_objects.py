"""Object sets: built-in ones, folders of URDF files and plain meshes."""

import sys
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_sim.engine import World
from edgegrasp_sim.objects import (
    LONGEST_SIDE,
    SHORTEST_SIDE,
    ObjectModel,
    ObjectSet,
    SceneKind,
    cache_folder,
    prepare_mesh,
)
from edgegrasp_sim.scene import load_object

MARGIN = {"pybullet": 0.006, "mujoco": 0.0}  # metres that an engine's boxes are wider


def extents(world: World, model: ObjectModel, scale: float = 1.0) -> np.ndarray:
    item = load_object(world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), scale)
    found: np.ndarray = np.ptp(item.body.bounds, axis=0)
    item.body.remove()
    return found - MARGIN[world.name]


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
    objects = ObjectSet.from_folder(tmp_path, SceneKind.PACKED, "train")
    assert [model.name for model in objects.models] == ["a", "b", "c"]
    assert objects.name == "packed/train"
    with pytest.raises(ValueError, match=r"a\.urdf cannot be read"):
        assert objects.digest


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
    return cache_folder()


def test_meshes_of_any_unit_are_scaled_to_the_hand(world: World, meshes: Path, cache: Path) -> None:
    models = ObjectSet.from_folder(meshes, SceneKind.PILE).models
    assert [model.name for model in models] == ["Brick", "ring"]
    brick, ring = (np.sort(extents(world, model)) for model in models)
    np.testing.assert_allclose(brick, LONGEST_SIDE * np.array([0.25, 0.5, 1.0]), atol=1e-3)
    # A ring of six-sided tubes is a little lower than it is thick.
    assert ring[0] == pytest.approx(LONGEST_SIDE / 4, rel=0.15)
    assert max(brick[0], ring[0]) <= SHORTEST_SIDE


def test_prepared_meshes_are_cached_by_content(meshes: Path, cache: Path, tmp_path: Path) -> None:
    urdf = prepare_mesh(meshes / "ring.obj")
    assert urdf.is_relative_to(cache)
    before = urdf.stat().st_mtime_ns
    copy = tmp_path / "other name.obj"
    copy.write_bytes((meshes / "ring.obj").read_bytes())
    assert prepare_mesh(copy) == urdf
    assert urdf.stat().st_mtime_ns == before
    copy.write_bytes((meshes / "ring.obj").read_bytes() + b"\n# changed\n")
    again = prepare_mesh(copy)
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
