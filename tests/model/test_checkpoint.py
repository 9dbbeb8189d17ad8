"""Checkpoints of ours, and those of the authors' made into ours."""

import hashlib
import json
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load, load_file, save_file

from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.networks.checkpoint import (
    check_reference_logits,
    load_checkpoint,
    save_checkpoint,
)
from edgegrasp_model.networks.config import HAND_DESCRIPTION_SIZE as SIZE
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_training.import_checkpoint import import_checkpoint
from edgegrasp_training.recipes import RECIPES, build_network, set_statistics

CONFIG, EDGEGRASP = RECIPES["edgegrasp-plus"], RECIPES["edgegrasp"]
METADATA = CheckpointMetadata(
    name="edgegrasp-plus",
    network=CONFIG,
    voxel_size=0.0045,
    gripper="panda",
    temperature=1.3,
    training={"steps": 12, "data": ["packed", "pile"]},
)
PARTS = ("local_emd_model", "global_emd_model", "classifier_model")


class Trap:
    """What runs code where a pickle is opened."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return self.path.touch, ()


@pytest.fixture(scope="module")
def network() -> torch.nn.Module:
    """A hand network with statistics."""
    network = build_network(CONFIG, torch.Generator().manual_seed(7))
    set_statistics(network, torch.linspace(-1, 1, SIZE), torch.linspace(1, 2, SIZE))
    return network


@pytest.fixture
def path(tmp_path: Path, network: torch.nn.Module) -> Path:
    path = tmp_path / "edgegrasp-plus.safetensors"
    save_checkpoint(path, network, METADATA)
    return path


def test_a_checkpoint_survives_the_round_trip_and_computes_what_it_did(path, network) -> None:
    loaded, read = load_checkpoint(path)
    written = replace(read, digest="", tensors_digest="", reference_logits=())
    assert written == replace(METADATA, reference_logits=())
    assert read.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert not loaded.training
    expected = network.state_dict()
    assert "mean" in expected
    assert loaded.state_dict().keys() == expected.keys()
    for name, value in loaded.state_dict().items():
        assert torch.equal(value, expected[name]), name
    check_reference_logits(loaded, read)
    check_reference_logits(loaded, replace(read, reference_logits=()))  # of older files
    with pytest.raises(InvalidCheckpoint, match="edgegrasp-plus"):
        check_reference_logits(build_network(CONFIG), read)


def assert_refused(read: Callable[[Path], object], path: Path, complaint: str) -> None:
    with pytest.raises(InvalidCheckpoint, match=complaint):
        read(path)


def test_truncated_missing_pickled_foreign_and_damaged_files_are_refused(path: Path) -> None:
    data, trap = path.read_bytes(), Trap(path.with_name("sprung"))
    tensors = load(data)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    cut = [data[: int(len(data) * kept)] for kept in (0.0, 0.001, 0.2, 0.999)]
    for content in (*cut, pickle.dumps(trap)):
        path.write_bytes(content)
        assert_refused(load_checkpoint, path, path.name)
    assert not trap.path.exists()
    for value in (7.0, float("nan")):
        tensors["mean"][3] = value
        save_file(tensors, path, metadata=metadata)
        assert_refused(load_checkpoint, path, path.name)
    save_file({"weight": torch.zeros(3)}, path)
    assert_refused(load_checkpoint, path, "metadata")
    path.unlink()
    assert_refused(load_checkpoint, path, path.name)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"format": 2}, "format: got 2"),
        ({"format": None}, "format"),
        ({"network": {"architecture": "gpd"}}, "architecture.*gpd"),
        ({"network": asdict(CONFIG) | {"dropout": 0.1}}, "dropout"),
        ({"network": {"architecture": "hand"}}, r"hand_widths: got \(\)"),
        ({"network": asdict(EDGEGRASP) | {"conv_widths": (32, 64)}}, "conv_widths"),
        ({"network": asdict(EDGEGRASP) | {"global_widths_2": (8, 0)}}, "global_widths_2"),
        ({"network": asdict(EDGEGRASP) | {"classifier_widths": (8.5,)}}, "classifier_widths"),
        ({"network": asdict(EDGEGRASP) | {"crop_radius": 50.0}}, "crop_radius"),
        ({"network": asdict(CONFIG) | {"k": 0}}, "k"),
        ({"network": asdict(CONFIG) | {"description_size": 500}}, "description_size"),
        ({"network": None}, "network"),
        ({"network": [1]}, "metadata"),
        ({"network": asdict(replace(CONFIG, classifier_widths=(24, 20)))}, r"classifier\.0"),
        ({"voxel_size": None}, "voxel_size"),
        ({"voxel_size": 4.5}, "voxel_size.*4.5"),
        ({"temperature": 0.0}, "temperature.*0.0"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_unusable_metadata_is_refused(path: Path, changes: dict[str, Any], complaint: str) -> None:
    with safe_open(path, framework="pt") as file:
        values = json.loads(file.metadata()["edgegrasp"]) | changes
    values = {name: value for name, value in values.items() if value is not None}
    save_file(load_file(path), path, metadata={"edgegrasp": json.dumps(values)})
    assert_refused(load_checkpoint, path, f"(?s){path.name}.*{complaint}")


def write_layout(directory: Path, number: int = 1, **weights: object) -> None:
    """Files in the authors' layout, without a tensor unless one is given."""
    for part in PARTS:
        torch.save(weights.get(part, {}), directory / f"{part}-ckpt-{number}.pt")


def test_none_two_missing_truncated_and_trapped_parts_are_named(tmp_path: Path) -> None:
    assert_refused(import_checkpoint, tmp_path, "0 files")
    write_layout(tmp_path, 1)
    write_layout(tmp_path, 2)
    assert_refused(import_checkpoint, tmp_path, "2 files")
    for file in tmp_path.iterdir():
        file.unlink()
    write_layout(tmp_path, local_emd_model={"weight": torch.zeros(1000)})
    first, second, third = (tmp_path / f"{part}-ckpt-1.pt" for part in PARTS)
    third.unlink()
    assert_refused(import_checkpoint, tmp_path, third.name)
    torch.save({"weight": Trap(tmp_path / "sprung")}, second, pickle_module=pickle)
    assert_refused(import_checkpoint, tmp_path, second.name)
    assert not (tmp_path / "sprung").exists()
    first.write_bytes(first.read_bytes()[:500])
    assert_refused(import_checkpoint, tmp_path, first.name)


@pytest.mark.parametrize(
    ("weights", "complaint"),
    [
        (torch.zeros(3), "a Tensor"),
        ({"head.0.weight": torch.zeros(256, 1162), "unheard.of": torch.zeros(1)}, "unheard.of"),
        ({"head.0.weight": torch.zeros(256, 1162)}, r"size mismatch for join\.weight"),
        ({"head.0.weight": torch.zeros(512, 1000)}, "does not fit edgegrasp"),
    ],
)
def test_other_weights_are_refused(tmp_path: Path, weights: object, complaint: str) -> None:
    write_layout(tmp_path, classifier_model=weights)
    assert_refused(import_checkpoint, tmp_path, f"(?s){complaint}")
