import numpy as np
import pytest
import torch

from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.options import Collision, parse_options

from .scenes import PANDA, TINY, box_on_table, scene_of


@pytest.mark.parametrize(
    ("camera", "blocked"),
    [((-0.6, 0.0, 0.0), True), ((0.6, 0.0, 0.0), False), (None, False)],
    ids=["in front of the plate", "behind it, with the hand", "unknown"],
)
def test_a_palm_in_space_that_no_camera_saw_counts_as_colliding(camera, blocked) -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(-0.2, 0.3, 0.004))
    plate = np.stack([np.full_like(y, -0.1), y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    viewpoints = None if camera is None else np.array([camera], dtype=np.float32)
    behind, hand = scene_of(plate, viewpoints=viewpoints), np.eye(4, dtype=np.float32)[None]
    assert collides(behind, hand, PANDA, Collision()).tolist() == [blocked]


def hopeless() -> GraspDetector:
    """A detector to which no grasp seems any good."""
    network = build_network(TINY["hand"])
    with torch.no_grad():
        list(network.parameters())[-1].fill_(-50.0)  # the bias of the last layer
    return GraspDetector(network, CheckpointMetadata("no", TINY["hand"], 0.0045, "panda"), PANDA)


LID = [{"kind": "box", "min": (-0.5, -0.5, 0.09), "max": (0.5, 0.5, 0.2)}]


@pytest.mark.parametrize(
    ("size", "options", "reason"),
    [
        ((0.10, 0.13, 0.10), {}, "too-wide"),
        ((0.03, 0.05, 0.008), {}, "too-flat"),
        ((0.04, 0.06, 0.08), {"collision": {"obstacles": LID}}, "blocked"),
        ((0.04, 0.06, 0.08), {"viewpoint": (1.0, 0.0, 0.04)}, "hidden"),
        ((0.04, 0.06, 0.08), {"viewpoint": None}, None),  # nobody can say
    ],
)
def test_an_object_without_a_good_grasp_has_a_reason(size, options, reason) -> None:
    floor = {"normal": (0, 0, 1), "offset": 0.0}
    known = {"viewpoint": (0.3, 0.2, 0.5), "support": floor, "objects": "off"}
    asked = parse_options(known | {"approach_direction": {"preset": "top-down"}} | options)
    (single,) = hopeless().detect(box_on_table(3000, size=size), asked).objects
    assert single.reason == reason
