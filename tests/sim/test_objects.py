from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from edgegrasp_sim.engine import World
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.scene import load_object

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("scene", SceneKind)
def test_builtin_objects_fit_between_the_fingers(scene: SceneKind) -> None:
    models = ObjectSet.builtin(scene).models
    assert len({model.urdf for model in models}) == len({model.name for model in models}) >= 8
    with World() as world:
        for model in models:
            item = load_object(world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), 0.8)
            extent = np.sort(np.ptp(item.body.bounds, axis=0))
            # A mug is gripped by its wall or handle; everything else between the fingers.
            assert model.name == "mug" or extent[0] < 0.075, model.name
            assert extent[2] < 0.25, model.name


def test_folder_is_read_in_order_of_names(tmp_path: Path) -> None:
    folder = tmp_path / "packed" / "train"
    folder.mkdir(parents=True)
    for name in ("b", "a", "c"):
        (folder / f"{name}.urdf").touch()
    (folder / "a_visual.obj").touch()
    objects = ObjectSet.from_folder(tmp_path, SceneKind.PACKED, "train")
    assert [model.name for model in objects.models] == ["a", "b", "c"]
    assert objects.name == "packed/train"


def test_missing_folder_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"<scene>/<split>/<name>\.urdf"):
        ObjectSet.from_folder(tmp_path, SceneKind.PILE)


def test_empty_set_is_refused() -> None:
    with pytest.raises(ValueError, match="'nothing' is empty"):
        ObjectSet("nothing", ())
