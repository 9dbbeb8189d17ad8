"""What each shipped model is: its widths and what it reads."""

from dataclasses import replace

from edgegrasp_model.networks.config import (
    EDGEGRASP,
    EDGEGRASP_SMALL,
    HAND,
    VN_EDGEGRASP,
    CheckpointMetadata,
    NetworkConfig,
)

CROP_RADIUS = 0.04  # metres; half the gripper's opening, as in the paper
VOXEL_SIZE = 0.0045  # metres; that of the training views
GRIPPER = "panda"

RECIPES: dict[str, NetworkConfig] = {
    "edgegrasp": replace(EDGEGRASP, crop_radius=CROP_RADIUS),
    "edgegrasp-small": replace(EDGEGRASP_SMALL, crop_radius=CROP_RADIUS),
    "edgegrasp-plus": replace(HAND, crop_radius=CROP_RADIUS),
    "vn-edgegrasp": replace(VN_EDGEGRASP, crop_radius=CROP_RADIUS),
}


def recipe(name: str) -> CheckpointMetadata:
    """What a new network of that name says of itself.

    Raises:
        ValueError: There is no such recipe.
    """
    if name not in RECIPES:
        raise ValueError(f"model: got {name!r}. Use one of: {', '.join(RECIPES)}.")
    return CheckpointMetadata(name, RECIPES[name], VOXEL_SIZE, GRIPPER)
