from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_training.ball_network import LENGTH_UNIT, in_metres, in_units, prepare_to_train
from edgegrasp_training.examples import pack_balls, tried_grasps
from edgegrasp_training.views import LabelledView

MakeView = Callable[[int], LabelledView]
TINY = NetworkConfig("edgegrasp", (8, 8, 8), (8, 8, 8), (8, 8), (16, 8), crop_radius=0.04)
VN = NetworkConfig("vn-edgegrasp", (4, 4, 4), (4, 4, 4), (4, 4), (8, 8), crop_radius=0.04)


@pytest.mark.parametrize("config", [TINY, VN], ids=["edgegrasp", "vn-edgegrasp"])
def test_a_network_trained_in_other_units_scores_the_same_in_metres(
    made_up_view: MakeView, config: NetworkConfig
) -> None:
    grasps = tried_grasps(made_up_view(1), config, load_gripper())
    batch = pack_balls(grasps, grasps.balls(), config).batch
    network = build_network(config, torch.Generator().manual_seed(1))
    prepare_to_train(network)
    network = network.double()
    points, depth = batch.points.double(), batch.depth.double()
    own = replace(
        batch,
        points=points,
        depth=depth,
        normals=batch.normals.double(),
        approach=batch.approach.double(),
    )
    metres = replace(own, points=points * LENGTH_UNIT, depth=depth * LENGTH_UNIT)
    with torch.no_grad():
        scores = network(own)
        torch.testing.assert_close(in_metres(network)(metres), scores, rtol=0, atol=0)
        assert not torch.allclose(network(metres), scores, rtol=0, atol=1e-6)
    for name, weight in in_units(in_metres(network)).state_dict().items():
        torch.testing.assert_close(weight, network.state_dict()[name], rtol=0, atol=0)


@pytest.mark.parametrize("architecture", ["edgegrasp", "vn-edgegrasp"])
def test_scores_of_an_untrained_network_of_full_depth_differ(
    made_up_view: MakeView, architecture: str
) -> None:
    config = NetworkConfig(
        architecture, (32, 32, 32), (32, 32, 32), (64, 64), (64, 32, 16), crop_radius=0.04
    )
    grasps = tried_grasps(made_up_view(1), config, load_gripper())
    batch = pack_balls(grasps, grasps.balls(), config).batch
    network = build_network(config)
    with torch.no_grad():
        before = network(batch).std()
        prepare_to_train(network)
        assert network(batch).std() > 5 * before
