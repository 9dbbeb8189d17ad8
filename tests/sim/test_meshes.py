"""Object sets from plain meshes."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from edgegrasp_sim.benchmark import BenchmarkConfig, objects_digest, run_benchmark
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
from edgegrasp_sim.scene import OBJECT_MASS, add_table, load_object
from edgegrasp_sim.top_down import plan_top_down

if TYPE_CHECKING:
    from pathlib import Path

trimesh = pytest.importorskip("trimesh", reason="the extra `meshes` is not installed")
pytest.importorskip("coacd", reason="the extra `meshes` is not installed")


MARGIN = 0.006  # metres that the engine's boxes are wider than what is in them


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring in millimetres, a brick in metres."""
    folder = tmp_path_factory.mktemp("meshes")
    ring = trimesh.creation.torus(30.0, 10.0, major_sections=10, minor_sections=6)
    ring.export(folder / "ring.obj")
    trimesh.creation.box((0.1, 0.2, 0.4)).export(folder / "Brick.STL")
    (folder / "notes.txt").write_text("no mesh")
    return folder


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One cache for this file's tests, so that each mesh is taken apart once."""
    root = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(root))
    return cache_folder()


def test_meshes_of_any_unit_are_scaled_to_the_hand(meshes: Path, cache: Path) -> None:
    models = ObjectSet.from_folder(meshes, SceneKind.PILE).models
    assert [model.name for model in models] == ["Brick", "ring"]
    with World() as world:
        sides = [
            np.sort(
                np.ptp(
                    load_object(world, model, (0, 0, 1), (0, 0, 0, 1), 1.0).body.bounds,
                    axis=0,
                )
            )
            for model in models
        ]
    np.testing.assert_allclose(
        sides[0] - MARGIN, LONGEST_SIDE * np.array([0.25, 0.5, 1.0]), atol=1e-3
    )
    # A ring of six-sided tubes is a little lower than it is thick.
    assert sides[1][0] - MARGIN == pytest.approx(LONGEST_SIDE / 4, rel=0.15)
    assert max(side[0] for side in sides) <= SHORTEST_SIDE + MARGIN


def test_a_ring_has_a_hole_and_every_object_s_mass(meshes: Path, cache: Path) -> None:
    urdf = prepare_mesh(meshes / "ring.obj")
    with World() as world:
        add_table(world)
        ring = load_object(world, ObjectModel("ring", urdf), (0.15, 0.15, 0.07), (0, 0, 0, 1), 1.0)
        above = np.array([[x, 0.15, 0.3] for x in (0.15, 0.15 + 0.055)])
        below = above - np.array([0.0, 0.0, 0.245])
        assert world.first_hits(above, below) == [-1, ring.body.uid]
        # The centre of mass is in the middle of the hole, where the body's frame is.
        np.testing.assert_allclose(ring.body.position, (0.15, 0.15, 0.07), atol=2e-3)
    assert f'mass value="{OBJECT_MASS}"' in urdf.read_text()


def test_what_is_prepared_is_kept_by_content(meshes: Path, cache: Path, tmp_path: Path) -> None:
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


def test_rounds_run_on_a_folder_of_meshes(meshes: Path, cache: Path) -> None:
    config = BenchmarkConfig(SceneKind.PACKED, 1, objects=meshes)
    (done,) = run_benchmark(config, lambda: plan_top_down)
    assert set(done.objects) <= {"Brick", "ring"}
    assert done.attempts
    assert len(objects_digest(config.object_set())) == 64


def test_meshes_may_lie_in_the_usual_folders(meshes: Path, cache: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pile" / "test"
    folder.mkdir(parents=True)
    (folder / "ring.obj").write_bytes((meshes / "ring.obj").read_bytes())
    objects = ObjectSet.from_folder(tmp_path, SceneKind.PILE)
    assert (objects.name, [model.name for model in objects.models]) == ("pile/test", ["ring"])
    # Beside URDF files, meshes are parts of those.
    (folder / "mug.urdf").touch()
    objects = ObjectSet.from_folder(tmp_path, SceneKind.PILE)
    assert [model.name for model in objects.models] == ["mug"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("v 0 0 0\n", "holds no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no solid object"),
        ("v 0 0 zero\nf 1 2 3\n", "cannot be read"),
    ],
)
def test_a_file_without_a_solid_is_told(
    cache: Path, tmp_path: Path, content: str, message: str
) -> None:
    (tmp_path / "thing.obj").write_text(content)
    with pytest.raises(ValueError, match=rf"thing\.obj.*({message})"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)


def test_two_meshes_of_one_name_are_told(cache: Path, tmp_path: Path) -> None:
    for name in ("cup.obj", "cup.stl"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match="several meshes named cup"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)


@pytest.mark.parametrize("package", ["coacd", "trimesh"])
def test_a_missing_package_is_named(
    meshes: Path, cache: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RuntimeError, match=rf"{package} is not .*edgegrasp\[meshes\]"):
        ObjectSet.from_folder(meshes, SceneKind.PILE)
