import pickle

import pytest
import torch

from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import EDGEGRASP, VN_EDGEGRASP
from edgegrasp_model.networks.import_checkpoint import import_checkpoint

PARTS = ("local_emd_model", "global_emd_model", "classifier_model")


def write_layout(directory, number=1, **weights):
    """Files in the authors' layout, without a tensor unless one is given."""
    for part in PARTS:
        torch.save(weights.get(part, {}), directory / f"{part}-ckpt-{number}.pt")


def test_the_authors_vn_checkpoint_becomes_ours(shared_dir, tmp_path):
    network, metadata = import_checkpoint(shared_dir / "reference" / "vn_edge_grasp")
    assert metadata.name == "vn-edgegrasp"
    assert metadata.network == VN_EDGEGRASP
    assert metadata.training["checkpoint"] == 105
    save_checkpoint(tmp_path / "vn.safetensors", network, metadata)
    loaded, _ = load_checkpoint(tmp_path / "vn.safetensors")
    for name, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name


def test_radius_voxel_and_gripper_are_noted(shared_dir):
    _, metadata = import_checkpoint(
        shared_dir / "reference" / "edge_grasp_random",
        voxel_size=0.004,
        crop_radius=0.04,
        gripper="other",
    )
    assert metadata.network.conv_widths == EDGEGRASP.conv_widths
    assert (metadata.voxel_size, metadata.network.crop_radius, metadata.gripper) == (
        0.004,
        0.04,
        "other",
    )


def test_an_empty_directory_is_refused(tmp_path):
    with pytest.raises(InvalidCheckpoint, match=r"with 0 files local_emd_model-ckpt-N\.pt"):
        import_checkpoint(tmp_path)


def test_two_checkpoints_in_one_directory_are_refused(tmp_path):
    write_layout(tmp_path, 1)
    write_layout(tmp_path, 2)
    with pytest.raises(InvalidCheckpoint, match=r"with 2 files .* exactly one"):
        import_checkpoint(tmp_path)


def test_a_missing_part_is_named(tmp_path):
    write_layout(tmp_path)
    (tmp_path / "classifier_model-ckpt-1.pt").unlink()
    with pytest.raises(InvalidCheckpoint, match=r"classifier_model-ckpt-1\.pt, which cannot be"):
        import_checkpoint(tmp_path)


def test_a_truncated_part_is_named(tmp_path):
    write_layout(tmp_path, local_emd_model={"weight": torch.zeros(1000)})
    path = tmp_path / "local_emd_model-ckpt-1.pt"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InvalidCheckpoint, match=r"local_emd_model-ckpt-1\.pt, which cannot be"):
        import_checkpoint(tmp_path)


def test_code_in_a_part_is_refused_and_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("sprung").touch, ())

    write_layout(tmp_path)
    torch.save({"weight": Trap()}, tmp_path / "global_emd_model-ckpt-1.pt", pickle_module=pickle)
    with pytest.raises(InvalidCheckpoint, match=r"global_emd_model-ckpt-1\.pt"):
        import_checkpoint(tmp_path)
    assert not (tmp_path / "sprung").exists()


def test_what_is_no_state_dict_is_refused(tmp_path):
    write_layout(tmp_path, classifier_model=torch.zeros(3))
    with pytest.raises(InvalidCheckpoint, match=r"with a Tensor\. Give a state dict"):
        import_checkpoint(tmp_path)


def test_other_widths_are_refused(tmp_path):
    weights = {"head.0.weight": torch.zeros(256, 1162), "unheard.of": torch.zeros(1)}
    write_layout(tmp_path, classifier_model=weights)
    with pytest.raises(InvalidCheckpoint, match=r"(?s)does not fit edgegrasp .*unheard\.of"):
        import_checkpoint(tmp_path)
    with pytest.raises(InvalidCheckpoint, match=r"(?s)size mismatch for join\.weight"):
        import_checkpoint(tmp_path)


def test_an_input_of_another_width_is_refused(tmp_path):
    write_layout(tmp_path, classifier_model={"head.0.weight": torch.zeros(512, 1000)})
    with pytest.raises(InvalidCheckpoint, match="does not fit edgegrasp"):
        import_checkpoint(tmp_path)
