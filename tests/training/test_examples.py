from dataclasses import replace

import numpy as np
import torch

from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_description import Surroundings
from edgegrasp_model.networks.config import NetworkConfig
from edgegrasp_model.networks.hand import HandBatch
from edgegrasp_model.scene.scene import near_workspace_side
from edgegrasp_training.examples import pack_balls, pack_hands, tried_grasps
from edgegrasp_training.recipes import LENGTH_UNIT
from edgegrasp_training.views import TABLE, UP, WORKSPACE

Networks = dict[str, NetworkConfig]


def test_packed_balls_hold_each_tried_grasp_and_its_contact(made_up_view, networks) -> None:
    balls = networks["balls"]
    grasps = tried_grasps(made_up_view(1), balls)
    batch, label, weight = pack_balls(grasps, grasps.balls(), balls)
    assert len(label) == len(grasps.label) == len(batch.contact)
    assert (weight == 1).all()
    contact = grasps.cloud.points[grasps.candidates.contact_index]
    edge = contact - grasps.cloud.points[grasps.candidates.approach_index]
    found = batch.points[batch.contact].numpy() * LENGTH_UNIT
    np.testing.assert_allclose(found, edge @ grasps.turn.T, atol=1e-6)
    depth = batch.depth.numpy() * LENGTH_UNIT
    np.testing.assert_allclose(depth, grasps.candidates.depth, atol=1e-6)
    some = pack_balls(grasps, grasps.balls()[:2], balls)
    assert some.batch.num_balls == 2
    assert 0 < len(some.label) < len(label)


def test_packed_hands_are_what_the_detector_would_pack_and_vary(made_up_view, networks) -> None:
    view, hands = made_up_view(1), networks["hands"]
    grasps = tried_grasps(view, hands)
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


def test_a_grasp_that_stays_when_shaken_is_worth_a_little_more(made_up_view, networks) -> None:
    view, balls = made_up_view(1), networks["balls"]
    firm = np.where(view.success == 1, np.arange(len(view.success)) % 2, view.success)
    shaken = tried_grasps(replace(view, firm=firm.astype(np.int8)), balls).label
    unknown = tried_grasps(view, balls).label
    assert set(shaken.tolist()) == {0.0, 1.0, np.float32(0.8)}
    assert len(set(unknown.tolist())) == 2
    np.testing.assert_array_equal(unknown > 0.5, shaken > 0.5)
    assert 0.8 < unknown.max() < 1
