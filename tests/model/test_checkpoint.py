import hashlib
import json
import pickle
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE as SIZE
from edgegrasp_model.networks.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import HAND, CheckpointMetadata


@pytest.fixture
def saved(tmp_path, tiny_config):
    """A hand network with statistics, its metadata, and the file that holds both."""
    config = replace(HAND, crop_radius=0.04)
    network = build_network(config, torch.Generator().manual_seed(7))
    network.set_statistics(torch.randn(SIZE), torch.rand(SIZE) + 1.0)
    metadata = CheckpointMetadata(
        name="edgegrasp-plus",
        network=config,
        voxel_size=0.0045,
        gripper="panda",
        temperature=1.3,
        training={"steps": 12, "data": ["packed", "pile"]},
    )
    path = tmp_path / "edgegrasp-plus.safetensors"
    save_checkpoint(path, network, metadata)
    return path, network, metadata


def test_a_checkpoint_survives_the_round_trip(saved):
    path, network, metadata = saved
    loaded, read = load_checkpoint(path)
    assert read == replace(metadata, digest=hashlib.sha256(path.read_bytes()).hexdigest())
    assert (read.crop_radius, read.k) == (0.04, 16)
    assert not loaded.training
    expected = network.state_dict()
    assert "mean" in expected
    assert loaded.state_dict().keys() == expected.keys()
    for name, value in loaded.state_dict().items():
        assert torch.equal(value, expected[name]), name


def test_the_same_network_makes_the_same_bytes(saved, tmp_path):
    path, network, metadata = saved
    again = tmp_path / "again.safetensors"
    save_checkpoint(again, network, replace(metadata, digest="of another file"))
    assert again.read_bytes() == path.read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([path.name, again.name])


@pytest.mark.parametrize("kept", [0.0, 0.001, 0.2, 0.999])
def test_a_truncated_file_is_refused(saved, kept):
    path, _, _ = saved
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(InvalidCheckpoint, match=r"plus\.safetensors, which cannot be read .* Give"):
        load_checkpoint(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InvalidCheckpoint, match=r"nowhere\.safetensors, which cannot be read"):
        load_checkpoint(tmp_path / "nowhere.safetensors")


def test_a_pickle_is_refused_unopened(tmp_path):
    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("sprung").touch, ())

    path = tmp_path / "trap.safetensors"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InvalidCheckpoint, match="cannot be read as safetensors"):
        load_checkpoint(path)
    assert not (tmp_path / "sprung").exists()


def test_foreign_safetensors_are_refused(tmp_path):
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": torch.zeros(3)}, path)
    with pytest.raises(InvalidCheckpoint, match="without edgegrasp metadata"):
        load_checkpoint(path)


def rewrite(path, tensors=None, **changes):
    """Writes a checkpoint anew with other tensors or metadata; None drops a field."""
    with safe_open(path, framework="pt") as file:
        values = json.loads(file.metadata()["edgegrasp"])
    values = {name: value for name, value in (values | changes).items() if value is not None}
    save_file(tensors or load_file(path), path, metadata={"edgegrasp": json.dumps(values)})


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"format": 2}, r"format: got 2\. This version reads 1"),
        ({"format": None}, "format"),
        ({"network": {"architecture": "gpd"}}, "architecture: got .*gpd"),
        ({"network": None}, "network"),
        ({"network": [1]}, "str"),
        ({"voxel_size": None}, "voxel_size"),
        ({"voxel_size": 4.5}, r"voxel_size: got 4\.5\. Give metres"),
        ({"temperature": 0.0}, r"temperature: got 0\.0"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_unusable_metadata_is_refused(saved, changes, complaint):
    path, _, _ = saved
    rewrite(path, **changes)
    with pytest.raises(InvalidCheckpoint, match=f"metadata is unusable .*{complaint}"):
        load_checkpoint(path)


def test_weights_that_do_not_fit_their_metadata_are_refused(saved):
    path, _, metadata = saved
    wider = replace(metadata.network, classifier_widths=(24, 20))
    rewrite(path, network=wider.to_dict())
    with pytest.raises(InvalidCheckpoint, match=r"(?s)do not fit its own metadata .*classifier\.0"):
        load_checkpoint(path)
