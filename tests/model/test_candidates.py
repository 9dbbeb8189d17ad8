"""Approach points, the candidates around them, and which of them a request allows."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.edge_grasps import (
    MAX_SHIFT,
    MIN_SHIFT,
    TIP_MARGIN,
    BallCrop,
    Candidates,
    centred_grasps,
    crop_balls,
    edge_grasps,
    retract,
    sample_approach_points,
    support_clearance,
)
from edgegrasp_model.candidates.sample import allowed_directions
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import ApproachDirection, Cone, SupportPlane
from edgegrasp_model.scene.cloud import Cloud

from .scenes import PANDA, SEED

TABLE = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)
RADIUS = 0.045
DOWN, UP = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("method", ["farthest", "uniform"])
@settings(deadline=None)
@given(seed=st.integers(0, SEED), count=st.integers(1, 60), size=st.integers(1, 40))
def test_approach_points_are_different_rows(method: str, seed: int, count: int, size: int) -> None:
    points = np.random.default_rng(seed).normal(size=(size, 3)).astype(np.float32)
    rows = sample_approach_points(points, count, method, np.random.default_rng(seed))
    assert len(set(rows.tolist())) == len(rows) == min(count, size)
    again = sample_approach_points(points, count, method, np.random.default_rng(seed))
    np.testing.assert_array_equal(rows, again)


def test_farthest_points_spread_out() -> None:
    line = np.zeros((101, 3), np.float32)
    line[:, 0] = np.linspace(0, 1, 101)
    rows = sample_approach_points(line, 5, "farthest", np.random.default_rng(0))
    gaps = np.diff(np.sort(line[rows, 0]))
    assert gaps.min() > 0.1


def random_pairs(seed: int, count: int = 200):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 0.06, (count, 3)).astype(np.float32) + np.float32([0, 0, 0.05])
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a, c = rng.integers(count, size=(2, 500))
    return Cloud(points, normals), edge_grasps(Cloud(points, normals), a, c, PANDA), a, c


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, SEED))
def test_poses_follow_the_definition_of_an_edge_grasp(seed: int) -> None:
    cloud, candidates, a, c = random_pairs(seed)
    np.testing.assert_array_equal(candidates.approach_index, a[candidates.pair])
    np.testing.assert_array_equal(candidates.contact_index, c[candidates.pair])
    pose = candidates.T_cloud_hand.astype(np.float64)
    turn = pose[:, :3, :3]
    identity = np.broadcast_to(np.eye(3), turn.shape)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), identity, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-5)

    def in_hand(points: np.ndarray) -> np.ndarray:
        return np.einsum("edk,ed->ek", turn, points - pose[:, :3, 3])

    p_a, p_c = cloud.points[candidates.approach_index], cloud.points[candidates.contact_index]
    n_c = cloud.normals[candidates.contact_index]
    np.testing.assert_allclose(
        np.einsum("edk,ed->ek", turn, n_c), [[0, 1, 0]] * len(p_a), atol=1e-4
    )
    contact, approach = in_hand(p_c), in_hand(p_a)
    np.testing.assert_allclose(contact[:, 2], PANDA.contact_z, atol=1e-5)
    np.testing.assert_allclose(contact[:, 0], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(approach[:, 2], PANDA.contact_z - candidates.depth, atol=1e-5)
    np.testing.assert_allclose(candidates.approach, -turn[:, :, 2], atol=1e-6)
    assert (np.abs(contact[:, 1]) < PANDA.max_opening / 2).all()


def test_a_point_does_not_make_an_edge_with_itself() -> None:
    cloud, _, _, _ = random_pairs(0)
    same = np.arange(len(cloud.points))
    assert len(edge_grasps(cloud, same, same, PANDA)) == 0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, SEED))
def test_support_clearance_is_the_lowest_point_of_any_box(seed: int) -> None:
    _, candidates, _, _ = random_pairs(seed)
    clearance = support_clearance(candidates.T_cloud_hand, TABLE, PANDA)
    rng = np.random.default_rng(seed)
    boxes = PANDA.boxes(PANDA.max_opening)
    samples = rng.uniform(size=(len(boxes), 2000, 3)).round()  # corners of each box
    points = (boxes[:, :1] + samples * (boxes[:, 1:] - boxes[:, :1])).reshape(-1, 3)
    for pose, expected in zip(candidates.T_cloud_hand[:5], clearance[:5], strict=True):
        heights = (points @ pose[:3, :3].T + pose[:3, 3])[:, 2] - TABLE.offset
        np.testing.assert_allclose(heights.min(), expected, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, SEED))
def test_hands_are_drawn_back_just_out_of_the_table(seed: int) -> None:
    _, candidates, _, _ = random_pairs(seed)
    before = support_clearance(candidates.T_cloud_hand, TABLE, PANDA)
    drawn, kept = retract(candidates, TABLE, PANDA)
    clear = drawn.take(kept)
    np.testing.assert_array_equal(drawn.T_cloud_hand[~kept], candidates.T_cloud_hand[~kept])
    after = support_clearance(clear.T_cloud_hand, TABLE, PANDA)
    assert (after >= -1e-6).all()
    assert set(candidates.pair[before >= 0]) <= set(clear.pair)
    shift = (
        clear.T_cloud_hand[:, :3, 3]
        - candidates.T_cloud_hand[np.isin(candidates.pair, clear.pair), :3, 3]
    )
    back = np.einsum("ed,ed->e", shift, clear.approach)
    np.testing.assert_allclose(shift, back[:, None] * clear.approach, atol=1e-6)
    assert (back >= -1e-7).all()
    assert (back <= PANDA.tip_z - PANDA.contact_z - TIP_MARGIN + 1e-6).all()
    np.testing.assert_allclose(after[back > 1e-6], 0.0, atol=1e-5)


def can(diameter: float, seed: int = 0) -> Cloud:
    """The lid and the side of an upright can, lid at z = 0."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi, 900)
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros(900)], axis=1)
    lid = out * (diameter / 2 * np.sqrt(rng.random(900)))[:, None]
    side = out * (diameter / 2) - np.stack([0 * turn, 0 * turn, rng.uniform(0, 0.08, 900)], axis=1)
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (900, 1)), out])
    return Cloud(np.concatenate([lid, side]).astype(np.float32), normals.astype(np.float32))


def candidates_of(cloud: Cloud, seed: int = 1) -> tuple[BallCrop, Candidates]:
    """Edge grasps around 12 points of the lid, and the balls they are in."""
    rng = np.random.default_rng(seed)
    middle = np.flatnonzero(np.linalg.norm(cloud.points, axis=1) < 0.012)
    approach = np.sort(rng.choice(middle, 12, replace=False))
    crop = crop_balls(cloud.points, approach, RADIUS)
    pairs = approach[crop.ball_of_point], crop.ball_rows
    return crop, edge_grasps(cloud, *pairs, PANDA)


def extents(cloud: Cloud, T_cloud_hand: np.ndarray) -> tuple[float, float]:
    """How far what is between the fingers reaches along the closing direction."""
    points = (cloud.points - T_cloud_hand[:3, 3]) @ T_cloud_hand[:3, :3]
    x, y, z = points.T
    between = (np.abs(x) < PANDA.pad_half_width) & (z > PANDA.palm_z) & (z < PANDA.tip_z)
    return float(y[between].min()), float(y[between].max())


def test_a_hand_on_a_wide_can_is_moved_to_its_middle() -> None:
    cloud = can(0.074)
    crop, candidates = candidates_of(cloud)
    further = centred_grasps(cloud.points, crop, candidates, PANDA)
    assert 0 < len(further) < len(candidates)
    before = {int(pair): row for row, pair in enumerate(candidates.pair)}
    for row in range(0, len(further), 7):
        original = candidates.T_cloud_hand[before[int(further.pair[row])]]
        moved = further.T_cloud_hand[row]
        np.testing.assert_array_equal(moved[:3, :3], original[:3, :3])
        shift = original[:3, :3].T @ (moved[:3, 3] - original[:3, 3])
        np.testing.assert_allclose(shift[[0, 2]], 0.0, atol=1e-6)
        assert MIN_SHIFT < abs(shift[1]) < MAX_SHIFT
        low, high = extents(cloud, moved)
        assert low == pytest.approx(-high, abs=0.002)  # the pads' surroundings count too
        low, high = extents(cloud, original)
        assert abs(low + high) / 2 > MIN_SHIFT - 0.001


def test_nothing_is_moved_where_the_middle_does_not_matter() -> None:
    cloud = can(0.05)
    assert len(centred_grasps(cloud.points, *candidates_of(cloud), PANDA)) == 0


def test_the_candidates_themselves_stay_where_they_are() -> None:
    cloud = can(0.07)
    crop, candidates = candidates_of(cloud)
    before = candidates.T_cloud_hand.copy()
    assert len(centred_grasps(cloud.points, crop, candidates, PANDA)) > 0
    np.testing.assert_array_equal(candidates.T_cloud_hand, before)
    none = candidates.take(np.empty(0, dtype=np.int64))
    assert len(centred_grasps(cloud.points, crop, none, PANDA)) == 0


@pytest.mark.parametrize("name", ["robotiq-2f-85", "robotiq-2f-140", "wsg-50"])
def test_every_hand_has_the_contact_between_its_fingers(name: str) -> None:
    hand, cloud = load_gripper(name), can(0.075)
    rng = np.random.default_rng(2)
    approach = np.sort(rng.choice(900, 8, replace=False))
    crop = crop_balls(cloud.points, approach, 0.07)
    candidates = edge_grasps(cloud, approach[crop.ball_of_point], crop.ball_rows, hand)
    with np.errstate(all="raise"):
        further = centred_grasps(cloud.points, crop, candidates, hand)
    assert np.isfinite(further.T_cloud_hand).all()


def tilted(degrees: float) -> np.ndarray:
    """The way of a hand that moves down, tilted toward x."""
    angle = math.radians(degrees)
    return np.array([[math.sin(angle), 0.0, -math.cos(angle)]])


@pytest.mark.parametrize(
    ("request_", "angles", "allowed"),
    [
        (ApproachDirection(preset="top-down"), [0, 29, 31, 90, 180], [1, 1, 0, 0, 0]),
        (ApproachDirection(preset="side"), [0, 59, 61, 119, 121], [0, 0, 1, 1, 0]),
        # The direction is the way the hand moves: down, not where it comes from.
        (
            ApproachDirection(cones=(Cone(direction=(0, 0, -5), max_angle=0.2),)),
            [0, 11, 12, 180],
            [1, 1, 0, 0],
        ),
        (
            ApproachDirection(cones=(Cone(direction=(1, 0, 0), max_angle=0.1),), preset="top-down"),
            [0, 45, 90, 180],
            [1, 0, 1, 0],
        ),
        # Nothing asked for: not from more than 6 degrees below the horizontal.
        (None, [0, 90, 95, 97, 180], [1, 1, 1, 0, 0]),
    ],
)
def test_directions_are_ways_the_hand_moves(
    request_: ApproachDirection | None, angles: list[float], allowed: list[int]
) -> None:
    ways = np.concatenate([tilted(angle) for angle in angles])
    assert allowed_directions(ways, request_, UP).tolist() == [bool(value) for value in allowed]


def test_cones_are_given_in_the_frame_of_the_cloud_and_presets_by_up() -> None:
    turn = Rotation.from_euler("xyz", [1.0, 2.0, 3.0])
    cone = ApproachDirection(
        cones=(Cone(direction=tuple(turn.inv().apply([0, 0, -1])), max_angle=0.01),)
    )
    assert allowed_directions(DOWN, cone, UP, turn.apply).tolist() == [True]
    assert allowed_directions(DOWN, cone, UP).tolist() == [False]
    sideways = ApproachDirection(preset="side")
    assert allowed_directions(DOWN, sideways, [1.0, 0.0, 0.0]).tolist() == [True]
