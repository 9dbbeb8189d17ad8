"""A detection with each gripper that ships, and with one sent inline."""

import tomllib
from typing import Any

import numpy as np
import pytest
import torch

from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import GRIPPER_FOLDER, gripper_from_fields, gripper_names, load_gripper
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.options import parse_options

TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (8, 8), crop_radius=0.04)
TABLE = {"normal": [0.0, 0.0, 1.0], "offset": 0.0}


def narrow_panda() -> dict[str, Any]:
    fields = tomllib.loads((GRIPPER_FOLDER / "panda.toml").read_text())
    return fields | {"name": "narrow", "max_opening": 0.05}


CHOICES = [*gripper_names(), narrow_panda()]


def post() -> np.ndarray:
    """The outside of a 30 x 36 x 80 mm box that stands on z = 0."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (6000, 3))
    face = rng.integers(3, size=len(points))
    points[np.arange(len(points)), face] = np.where(rng.random(len(points)) < 0.5, -0.5, 0.5)
    points[:, 2] = np.where((face == 2) & (points[:, 2] < 0), 0.5, points[:, 2])
    return (points * (0.03, 0.036, 0.08) + (0.0, 0.0, 0.04)).astype(np.float32)


@pytest.mark.parametrize("choice", CHOICES, ids=[*gripper_names(), "inline"])
def test_grasps_fit_the_gripper_that_was_asked_for(choice: Any) -> None:
    gripper = load_gripper(choice) if isinstance(choice, str) else gripper_from_fields(choice)
    network = build_network(TINY, torch.Generator().manual_seed(3))
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    options = {"gripper": choice, "support": TABLE, "viewpoint": [0.2, 0.1, 0.5], "top_k": 30}
    detector = GraspDetector(network, metadata, load_gripper("panda"))
    cloud = post()
    found = detector.detect(cloud, parse_options(options))
    assert len(found.grasps) >= 5, found.counts
    assert any("trained for" in each for each in found.warnings) == (gripper.name != "panda")
    for grasp in found.grasps:
        pose = grasp.T_cloud_hand.astype(np.float64)
        x, y, z = (grasp.contact_point - pose[:3, 3]) @ pose[:3, :3]
        assert abs(y) < gripper.max_opening / 2
        assert abs(x) < gripper.pad_half_width
        # Hands may be drawn back from the table until the contact is near the tips.
        inside = gripper.contact_z_at(2 * abs(y)) + gripper.tip_z - gripper.contact_z - z
        assert 0.002 - 1e-4 < inside < gripper.tip_z - gripper.contact_z + 1e-4
        assert grasp.width <= gripper.max_opening + 1e-6
        np.testing.assert_allclose(grasp.T_cloud_tcp, pose @ gripper.T_hand_tcp, atol=1e-6)
        seen = (cloud - pose[:3, 3]) @ pose[:3, :3]
        for low, high in gripper.boxes(gripper.max_opening):
            deep = ((seen > low + 0.006) & (seen < high - 0.006)).all(axis=1)
            assert not deep.any()  # nothing of the cloud, a voxel's size aside, is in the hand
            corners = np.array(np.meshgrid(*np.stack([low, high]).T)).reshape(3, -1)
            assert (pose[2, :3] @ corners + pose[2, 3]).min() > -1e-5  # nor is the table


def test_a_name_that_nobody_has_is_refused() -> None:
    network = build_network(TINY, torch.Generator().manual_seed(3))
    metadata = CheckpointMetadata("tiny", TINY, voxel_size=0.0045, gripper="panda")
    detector = GraspDetector(network, metadata, load_gripper("panda"))
    with pytest.raises(InvalidRequest, match=r"options\.gripper.*wsg-50"):
        detector.detect(post(), parse_options({"gripper": "../panda"}))
