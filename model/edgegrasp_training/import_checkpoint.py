"""Convert the authors' checkpoints, which store each part of a network in its own file.

Their layout (github.com/HaojHuang/Edge-Grasp-Network): `local_emd_model-ckpt-N.pt`,
`global_emd_model-ckpt-N.pt`, `classifier_model-ckpt-N.pt` and, for the VN network, `std-ckpt-N.pt`.
"""

import re
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import Tensor, nn

from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.networks.edgegrasp import GRASP_WIDTH
from edgegrasp_training.recipes import RECIPES, build_network

# The authors' evaluation: metres, metres, hand.
VOXEL_SIZE, CROP_RADIUS, GRIPPER = 0.0045, 0.05, "panda"
# The first word of a file's name is the prefix of its parts below.
_FILES = "local_emd_model", "global_emd_model", "classifier_model", "std"
# Patterns of their names, and our names.
_EDGEGRASP_PARTS = {
    r"local\.(conv\d)\.local_nn\.0": r"\1.hidden",
    r"local\.(conv\d)\.local_nn\.2": r"\1.output",
    r"global\.mlp1\.(\d)": r"ball_feature.mlp_1.\1",
    r"global\.mlp2\.0": r"ball_feature.join",
    r"global\.mlp2\.2": r"ball_feature.mlp_2.0",
    r"classifier\.head\.0": r"join",
    r"classifier\.head\.2": r"classifier.0",
    r"classifier\.head\.4": r"classifier.2",
    r"classifier\.head\.6": r"classifier.4",
}
_VN_PARTS = {
    r"local\.(conv\d)\.vn_linear_1\.map_to_feat": r"\1.hidden",
    r"local\.(conv\d)\.relu_1\.map_to_dir": r"\1.hidden_relu.direction",
    r"local\.(conv\d)\.vn_linear_2\.map_to_feat": r"\1.output",
    r"local\.(conv\d)\.map_to_dir\.map_to_feat": r"\1.reach",
    r"local\.relu(\d)\.map_to_dir": r"conv\1.output_relu.direction",
    r"global\.vn([12])\.map_to_feat": r"ball_feature.vn_\1.feature",
    r"global\.vn([12])\.map_to_dir": r"ball_feature.vn_\1.direction",
    r"global\.vn3\.map_to_feat": r"ball_feature.vn_3",
    r"global\.vn4\.map_to_feat": r"ball_feature.join.feature",
    r"global\.vn4\.map_to_dir": r"ball_feature.join.direction",
    r"global\.vn5\.map_to_feat": r"ball_feature.vn_5",
    r"global\.map_to_dir_([12])\.map_to_feat": r"ball_feature.maximum_\1.reach",
    r"global\.relu3\.map_to_dir": r"ball_feature.maximum_1.relu.direction",
    r"global\.relu5\.map_to_dir": r"ball_feature.maximum_2.relu.direction",
    r"std\.vn([12])\.map_to_feat": r"frame_\1.feature",
    r"std\.vn([12])\.map_to_dir": r"frame_\1.direction",
    r"std\.vn_lin": r"frame_3",
    r"classifier\.head\.(\d)": r"classifier.\1",
}


def import_checkpoint(directory: Path) -> tuple[nn.Module, CheckpointMetadata]:
    """Read a checkpoint in the authors' layout; with a `std` file it is a VN network.

    Returns arguments of `save_checkpoint`. Raises InvalidCheckpoint if a file is missing or wrong.
    """
    found = sorted(directory.glob("local_emd_model-ckpt-*.pt"))
    if len(found) != 1:
        raise InvalidCheckpoint(
            f"directory: got {directory} with {len(found)} files local_emd_model-ckpt-N.pt. "
            "Give a directory with the files of exactly one checkpoint."
        )
    number = found[0].stem.rpartition("-")[2]
    is_vn = (directory / f"std-ckpt-{number}.pt").exists()
    config = RECIPES["vn-edgegrasp" if is_vn else "edgegrasp"]
    config = replace(config, crop_radius=CROP_RADIUS)
    theirs = {
        f"{stem.partition('_')[0]}.{name}": weight
        for stem in _FILES[: 4 if is_vn else 3]
        for name, weight in _load_weights(directory / f"{stem}-ckpt-{number}.pt").items()
    }
    network = build_network(config)
    try:
        ours = _renamed(theirs, _VN_PARTS if is_vn else _EDGEGRASP_PARTS)
        if "join.weight" in ours:
            # Their order is point, normal, f3, ball, depth, approach; ours has f3 and ball last.
            sizes = [6, config.conv_widths[-1] + config.global_widths_2[-1], GRASP_WIDTH - 6]
            first, features, last = torch.split(ours["join.weight"], sizes, dim=1)
            ours["join.weight"] = torch.cat((first, last, features), dim=1)
        network.load_state_dict(ours)
    except RuntimeError as error:
        raise InvalidCheckpoint(
            f"directory: got {directory}, which does not fit {config.architecture} ({error}). "
            "Give the authors' layout at the paper's widths."
        ) from error
    metadata = CheckpointMetadata(config.architecture, config, VOXEL_SIZE, GRIPPER)
    training = {"source": "imported from the authors' layout", "checkpoint": number}
    return network.eval(), replace(metadata, training=training)


def _load_weights(path: Path) -> dict[str, Tensor]:
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(weights, dict):
            raise TypeError(f"it contains a {type(weights).__name__}")
    except (OSError, RuntimeError, EOFError, UnpicklingError, TypeError) as error:
        raise InvalidCheckpoint(
            f"directory: got {path}, which cannot be read as a state dict ({error}). "
            "Give complete files that contain only tensors."
        ) from error
    return weights


def _renamed(theirs: dict[str, Tensor], parts: dict[str, str]) -> dict[str, Tensor]:
    """Weights under our names; unknown names stay, so that load_state_dict reports them."""
    ours = {}
    for name, weight in theirs.items():
        for pattern, replacement in parts.items():
            name = re.sub(rf"^{pattern}(?=\.\w+$)", replacement, name)
        ours[name] = weight
    return ours
