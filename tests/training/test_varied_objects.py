import re
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_sim.engine import World
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.scene import load_object
from edgegrasp_training.generation import GenerationOptions, generate
from edgegrasp_training.shapes import DRAWN, HOLLOW, STRETCH, made_object, stretched, varied_objects
from edgegrasp_training.views import find_views, load_view


@pytest.fixture
def shapes(tmp_path: Path) -> tuple[ObjectModel, ...]:
    return tuple(made_object(name, tmp_path / "shapes") for name in HOLLOW)


def _extents(model: ObjectModel) -> np.ndarray:
    with World() as world:
        body = load_object(world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), 1.0).body
        low, high = body.bounds
        return high - low


def test_a_stretched_object_is_longer_by_each_factor(
    shapes: tuple[ObjectModel, ...], tmp_path: Path
) -> None:
    bowl = next(model for model in shapes if model.name == "made-bowl")
    longer = stretched(bowl, (1.3, 0.8, 2.0), tmp_path / "stretched")
    assert longer.name == "made-bowl"
    assert longer.origin is bowl
    margin = 0.004  # the engine's own, around every shape
    np.testing.assert_allclose(
        _extents(longer), _extents(bowl) * (1.3, 0.8, 2.0), atol=2 * margin, rtol=0
    )
    assert _extents(longer)[2] > 1.5 * _extents(bowl)[2]


def test_stretching_twice_multiplies(shapes: tuple[ObjectModel, ...], tmp_path: Path) -> None:
    once = stretched(shapes[0], (2.0, 1.0, 1.0), tmp_path / "once")
    twice = stretched(once, (1.5, 1.0, 0.5), tmp_path / "twice")
    assert 'scale="3.00000 1.00000 0.50000"' in twice.urdf.read_text()


def test_objects_that_are_no_meshes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "box.urdf"
    path.write_text(
        '<robot name="box"><link name="a"><visual><geometry><box size="1 1 1"/></geometry>'
        "</visual></link></robot>"
    )
    with pytest.raises(ValueError, match=r"box\.urdf.*plain meshes"):
        stretched(ObjectModel("box", path), (1.0, 1.0, 1.0), tmp_path)


def test_varied_sets_hold_both_sorts_and_depend_on_the_seed_alone(
    shapes: tuple[ObjectModel, ...], tmp_path: Path
) -> None:
    plain = ObjectSet("plain", shapes[:4])

    def descriptions(folder: str, seed: int) -> dict[str, str]:
        drawn = varied_objects(plain, tmp_path / folder, np.random.default_rng(seed))
        assert len(drawn.models) <= DRAWN
        texts = {model.name: model.urdf.read_text() for model in drawn.models}
        return {name: text.replace(f"/{folder}/", "/") for name, text in texts.items()}

    first = descriptions("a", 1)
    assert first == descriptions("b", 1)
    assert first != descriptions("c", 2)
    named = {model.name for model in plain.models}
    assert set(first) & named
    assert set(first) - named
    factors = [
        float(each)
        for text in first.values()
        for each in text.split('scale="')[1].split('"')[0].split()
    ]
    assert 1 / STRETCH <= min(factors) < 0.95
    assert 1.05 < max(factors) <= STRETCH


def test_some_are_stretched_alike_along_x_and_y(
    shapes: tuple[ObjectModel, ...], tmp_path: Path
) -> None:
    drawn = varied_objects(ObjectSet("plain", shapes), tmp_path, np.random.default_rng(0))
    alike = 0
    for model in drawn.models:
        found = re.search(r'scale="(\S+) (\S+) \S+"', model.urdf.read_text())
        assert found is not None
        alike += found[1] == found[2]
    assert 0 < alike < len(drawn.models)


def test_views_of_varied_scenes_name_the_objects_as_they_were(tmp_path: Path) -> None:
    train = tmp_path / "objects" / "pile" / "train"
    plain = ("made-bowl", "made-ring-flat", "made-tube")
    models = {name: made_object(name, train) for name in plain}
    (tmp_path / "objects" / "packed").symlink_to(tmp_path / "objects" / "pile")
    options = GenerationOptions(3, 1, 4, seed=2, kind=SceneKind.PILE)
    list(generate(tmp_path / "views", tmp_path / "objects", options))
    paths = find_views([tmp_path / "views"])
    assert [path.name for path in paths] == [f"pile_2-00000{k}_0.npz" for k in range(3)]
    views = [load_view(path) for path in paths]
    assert any(view.objects for view in views)
    for view in views:
        for name, digest in zip(view.objects, view.object_digests, strict=True):
            model = models.get(name) or made_object(name, tmp_path / "again")
            assert digest == model.digest
