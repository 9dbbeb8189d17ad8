from pathlib import Path

import pytest
from edgegrasp_training.quantisation import quantise_detector

from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.network import build_network
from edgegrasp_model.network_config import EDGEGRASP_SMALL, HAND, NetworkConfig
from edgegrasp_training.views import find_views

VIEWS = Path(__file__).parents[2] / "examples" / "labelled_views"


def detector(config: NetworkConfig) -> GraspDetector:
    metadata = CheckpointMetadata("any", config, 0.0045, "panda", 1.5, {"date": "now"})
    return GraspDetector(build_network(config), metadata, load_gripper("panda"))


def test_scores_on_the_example_views_are_those_of_float32() -> None:
    _, said, correlation = quantise_detector(detector(EDGEGRASP_SMALL), find_views([VIEWS])[::8])
    assert 0.999 < correlation < 1.0
    assert (said.name, said.network.architecture) == ("any-int8", "edgegrasp-int8")
    assert said.temperature == 1.5
    assert said.training == {"date": "now", "int8": {"quantised_from": "", "views": 2}}


def test_other_networks_are_refused_before_a_view_is_read() -> None:
    with pytest.raises(ValueError, match=r"architecture: got 'hand'\. int8 is for edgegrasp"):
        quantise_detector(detector(HAND), [Path("absent.npz")])
