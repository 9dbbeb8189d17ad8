from pathlib import Path

import numpy as np
import pytest

from edgegrasp_model.candidates.edge_grasps import edge_grasps
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.scene.cloud import Cloud
from edgegrasp_training.views import LabelledView, find_views

SAMPLE = Path(__file__).parents[2] / "examples" / "labelled_views"
NETWORKS = {  # small ones of every architecture
    "balls": NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (16, 8), crop_radius=0.04),
    "vn": NetworkConfig("vn-edgegrasp", (6, 6, 6), (6, 9, 9), (9, 9), (16, 8, 4), crop_radius=0.04),
    "hands": NetworkConfig(
        "hand", hand_widths=(8, 16), hand_points=16, classifier_widths=(16, 8), crop_radius=0.04
    ),
}


def made_up_view(seed: int) -> LabelledView:
    """A box on the table; grasps from above are said to hold, others not."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (300, 3)) * (0.05, 0.05, 0.06)
    face = rng.integers(3, size=300)
    points[np.arange(300), face] = np.sign(points[np.arange(300), face]) * (0.025, 0.025, 0.03)[0]
    normals = np.zeros((300, 3))
    normals[np.arange(300), face] = np.sign(points[np.arange(300), face])
    points += (0.15, 0.15, 0.085)
    cloud = Cloud(points.astype(np.float32), normals.astype(np.float32))
    approach = np.repeat(rng.choice(300, 6, replace=False), 30)
    contact = rng.integers(300, size=len(approach))
    made, _ = edge_grasps(cloud, approach, contact, load_gripper())
    label = np.full(len(approach), -1, np.int8)
    label[made.pair] = made.approach[:, 2] > 0.4
    camera = np.array([0.15, 0.15, 0.8], np.float32)
    return LabelledView(cloud.points, cloud.normals, camera, approach, contact, label)


@pytest.fixture(scope="session")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("views")
    for number in range(8):
        made_up_view(number).save(folder / f"packed_{number}_0.npz")
    return find_views([folder])
