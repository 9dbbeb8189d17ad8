from dataclasses import replace

import numpy as np
import pytest
import torch

from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_description import Surroundings
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.scene.scene import near_workspace_side
from edgegrasp_training.examples import (
    TriedGrasps,
    pack_hands,
    tried_grasps,
)
from edgegrasp_training.views import TABLE, UP, WORKSPACE, LabelledView

Networks = dict[str, NetworkConfig]


@pytest.fixture
def balls(networks: Networks) -> NetworkConfig:
    return networks["balls"]


@pytest.fixture
def hands(networks: Networks) -> NetworkConfig:
    return networks["hands"]


def grasps_of(view: LabelledView, config: NetworkConfig, *, camera: bool = True) -> TriedGrasps:
    return tried_grasps(view, config, viewpoint_known=camera)


def test_packed_hands_are_what_the_detector_would_pack_and_vary_with_a_stream(made_up_view, hands):
    view = made_up_view(1)
    grasps = grasps_of(view, hands)
    batch, label, _ = pack_hands(grasps, grasps.balls()[:2], hands)
    rows = np.flatnonzero(np.isin(grasps.candidates.approach_index, grasps.balls()[:2]))
    np.testing.assert_array_equal(label.numpy(), grasps.label[rows])
    side = near_workspace_side(view.points, WORKSPACE, UP, view.points)
    known = TABLE, view.camera_position[None], side, view.numbered_objects()
    around = Surroundings(grasps.cloud, UP, *known)
    candidates = grasps.candidates.take(rows)
    exact = HandBatch.of_hands(around, candidates, load_gripper(), hands.hand_points)
    torch.testing.assert_close(batch.description, exact.description, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(batch.point_count, exact.point_count)
    varied = pack_hands(grasps, grasps.balls()[:2], hands, np.random.default_rng(0)).batch
    assert not torch.equal(varied.points, batch.points)
    there = torch.arange(hands.hand_points) < varied.point_count[:, None]
    assert (varied.points[there].abs().sum(dim=1) > 0).all()
    assert (varied.points[~there] == 0).all()


def test_a_grasp_that_stays_when_shaken_is_worth_a_little_more(made_up_view, balls) -> None:
    view = made_up_view(1)
    firm = np.where(view.success == 1, np.arange(len(view.success)) % 2, view.success)
    shaken = grasps_of(replace(view, firm=firm.astype(np.int8)), balls).label
    unknown = grasps_of(view, balls).label
    assert set(shaken.tolist()) == {0.0, 1.0, np.float32(0.8)}
    assert len(set(unknown.tolist())) == 2
    np.testing.assert_array_equal(unknown > 0.5, shaken > 0.5)
    assert 0.8 < unknown.max() < 1
