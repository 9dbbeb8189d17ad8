"""Labelled depth images, and a few steps of training on them."""

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

pytest.importorskip("open3d", reason="rays are cast by Open3D")
pytest.importorskip("trimesh", reason="some background is made by trimesh")

from tests.cloud_files import block_obj

from edgegrasp_training import scene_images, scene_training
from edgegrasp_training.scene_images import DEPTH_UNIT, generate, make_images
from edgegrasp_training.scene_layouts import OBJECT, SUPPORT, PoolMesh, box, draw_scene, pool_mesh
from edgegrasp_training.scene_training import image_points, train


@pytest.fixture(scope="module")
def pool() -> list[PoolMesh]:
    rng = np.random.default_rng(0)
    return [pool_mesh(rng, box(rng.uniform(0.03, 0.12, 3), (0, 0, 0))) for _ in range(12)]


@pytest.mark.parametrize("seed", range(2))
def test_labels_agree_with_the_depths(pool: list[PoolMesh], seed: int) -> None:
    rng = np.random.default_rng(seed)
    images = []
    while len(images) < 3:
        images += make_images(draw_scene(rng, pool, []))
    for image in images:
        points = image_points(image)
        on = points[(image.label == SUPPORT) & (image.depth > 0)]
        heights = on @ image.plane[:3] - image.plane[3]
        if len(on) > 500:  # several supports may be in view, the main one among them
            assert np.median(np.abs(heights)) < 0.7
        for number in np.unique(image.label[image.label >= OBJECT]):
            mine = points[(image.label == number) & (image.depth > 0)]
            away = np.linalg.norm(mine - image.centre[number - OBJECT], axis=1)
            assert len(mine) == 0 or np.median(away) < 0.25
        assert abs(np.linalg.norm(image.up) - 1) < 1e-5
        assert image.depth.max() * DEPTH_UNIT < 13.2


def test_the_same_scene_is_made_again_from_its_seed(pool: list[PoolMesh]) -> None:
    one, other = (draw_scene(np.random.default_rng(5), pool, []) for _ in range(2))
    assert [label for _, label in one.parts] == [label for _, label in other.parts]
    for (mesh, _), (again, _) in zip(one.parts, other.parts, strict=True):
        np.testing.assert_array_equal(mesh[0], again[0])


@patch.multiple(scene_images, SCENES_PER_FILE=2, NUM_POOL=12, make_arms=lambda rng: [])
@patch.multiple(scene_training, HELD_OUT=1, BATCH=2)
def test_a_file_is_made_and_learned_from(tmp_path: Path) -> None:
    mesh = tmp_path / "block.obj"
    mesh.write_text(block_obj(0.05, 0.04, 0.06))
    generate(tmp_path / "data", [mesh], seed=1, numbers=range(2))
    assert len(list((tmp_path / "data").glob("scenes-????.npz"))) == 2
    train(tmp_path / "data", tmp_path / "run", seconds=0.2)
    assert (tmp_path / "run" / "scene.safetensors").is_file()
    assert "iou_object" in (tmp_path / "run" / "log.txt").read_text()
    with pytest.raises(ValueError, match="with 0 images and 1 files held out"):
        train(tmp_path / "nowhere", tmp_path / "run", seconds=60.0)
