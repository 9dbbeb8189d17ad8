import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.candidates.collision import hits_cloud, required_openings
from edgegrasp_model.candidates.edge_grasps import (
    EDGE_MARGIN,
    edge_grasps,
    support_clearance,
    top_down_grasps,
)
from edgegrasp_model.errors import InvalidGripper
from edgegrasp_model.gripper import GRIPPER_FOLDER, gripper_from_fields, gripper_names, load_gripper
from edgegrasp_model.hand_description import describe_hands
from edgegrasp_model.hand_view import hand_views, reach_of
from edgegrasp_model.options import Collision, GripperGeometry, SupportPlane
from edgegrasp_model.scene.cloud import Cloud

GRIPPERS = [load_gripper(name) for name in gripper_names()]
SWINGING = [gripper for gripper in GRIPPERS if gripper.swing is not None]
by_name = pytest.mark.parametrize("gripper", GRIPPERS, ids=lambda gripper: gripper.name)
HAND = np.eye(4, dtype=np.float32)[None]
swinging = pytest.mark.parametrize("gripper", SWINGING, ids=lambda gripper: gripper.name)


def panda_fields() -> dict[str, Any]:
    return tomllib.loads((GRIPPER_FOLDER / "panda.toml").read_text())


def edge_cloud(along: float, depth: float) -> Cloud:
    """p_a over p_c: the hand comes down, its fingers close along y."""
    points = np.array([[0.1, 0.2, 0.3], [0.1, 0.2 + along, 0.3 - depth]], np.float32)
    return Cloud(points, np.array([[0, 0, 1], [0, 1, 0]], np.float32))


def test_the_panda_has_its_published_dimensions() -> None:
    panda = load_gripper("panda")
    assert panda.max_opening == 0.08
    assert panda.palm_z == 0.0658
    assert panda.pad_half_width == 0.0105
    np.testing.assert_allclose(panda.finger_depth, 0.0392)
    np.testing.assert_allclose(panda.T_hand_tcp[:3, 3], [0, 0, 0.1034])


@pytest.mark.parametrize(
    ("name", "opening", "open_tip", "closed_tip", "body"),
    [
        ("panda", 0.080, 0.1122, 0.1122, (0.0632, 0.208)),
        ("robotiq-2f-85", 0.085, 0.1494, 0.1633, (0.075, 0.1484)),
        ("robotiq-2f-140", 0.140, 0.2095, 0.2330, (0.075, 0.1484)),
        ("wsg-50", 0.110, 0.1535, 0.1535, (0.050, 0.146)),
    ],
)
def test_each_gripper_that_ships_has_its_published_dimensions(
    name: str, opening: float, open_tip: float, closed_tip: float, body: tuple[float, float]
) -> None:
    gripper = load_gripper(name)
    assert gripper.name == name
    assert (gripper.max_opening, gripper.tip_z) == (opening, open_tip)
    assert gripper.tip_z + gripper.tip_advance(0.0) == pytest.approx(closed_tip, abs=1e-4)
    hand = np.array(gripper.hand_boxes)
    np.testing.assert_allclose((hand[:, 1] - hand[:, 0])[:, :2].max(axis=0), body, atol=1e-6)


@by_name
def test_the_tcp_lies_ahead_of_the_palm_among_the_fingers(gripper: Any) -> None:
    np.testing.assert_allclose(gripper.T_hand_tcp[:3, :3], np.eye(3))
    np.testing.assert_allclose(gripper.T_hand_tcp[:3, 3], [0, 0, gripper.tcp_z])
    assert gripper.palm_z < gripper.tcp_z <= gripper.max_tip_z + 1e-6


@by_name
def test_fingers_mirror_each_other_and_stand_the_opening_apart(gripper: Any) -> None:
    hands, fingers = len(gripper.hand_boxes), len(gripper.finger_boxes)
    for opening in (0.0, 0.05, gripper.max_opening):
        boxes = gripper.boxes(opening)
        right, left = boxes[hands : hands + fingers], boxes[hands + fingers :]
        np.testing.assert_allclose(right[:, 0, 1].min() - left[:, 1, 1].max(), opening, atol=1e-9)
        np.testing.assert_allclose(left[..., [0, 2]], right[..., [0, 2]])
        np.testing.assert_allclose(left[:, :, 1], -right[:, ::-1, 1])
        np.testing.assert_allclose(boxes[:hands], gripper.hand_boxes)
    many = gripper.boxes(np.array([0.01, 0.05]))
    np.testing.assert_array_equal(many, [gripper.boxes(0.01), gripper.boxes(0.05)])


@swinging
def test_swinging_fingers_stay_on_their_link_and_come_forward(gripper: Any) -> None:
    opening = np.linspace(0.0, gripper.max_opening, 50)
    advance = gripper.tip_advance(opening)
    outward = gripper.swing.reach - (gripper.max_opening - opening) / 2
    ahead = np.sqrt(gripper.swing.radius**2 - gripper.swing.reach**2) + advance
    np.testing.assert_allclose(np.hypot(outward, ahead), gripper.swing.radius)
    assert gripper.tip_advance(gripper.max_opening) == pytest.approx(0.0)
    assert gripper.max_tip_z == pytest.approx(gripper.tip_z + advance.max(), abs=1e-5)
    tips = gripper.boxes(opening)[:, :, 1, 2].max(axis=1)
    np.testing.assert_allclose(tips, gripper.tip_z + advance)


@swinging
def test_a_swinging_gripper_stays_clear_of_the_support_as_it_closes(gripper: Any) -> None:
    down = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)[None]
    down[0, 2, 3] = 0.5
    floor = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)
    clearance = support_clearance(down, floor, gripper)[0]
    lowest = min(0.5 - gripper.boxes(w)[:, 1, 2].max() for w in np.linspace(0, 0.08, 40))
    assert clearance == pytest.approx(lowest, abs=1e-5)


@by_name
@settings(max_examples=30, deadline=None)
@given(along=st.floats(0.004, 0.06), depth=st.floats(0.002, 0.05))
def test_an_edge_grasp_puts_its_contact_inside_the_fingertips(
    gripper: Any, along: float, depth: float
) -> None:
    cloud = edge_cloud(along, depth)
    grasps = edge_grasps(cloud, np.array([0]), np.array([1]), gripper)
    fits = np.hypot(along, depth) < gripper.max_opening / 2 - EDGE_MARGIN
    assert len(grasps) == int(fits and depth < gripper.finger_depth)
    for pose in grasps.T_cloud_hand:
        p_a, p_c = (cloud.points - pose[:3, 3]) @ pose[:3, :3]
        np.testing.assert_allclose(p_c[[0, 1]], [0, along], atol=1e-6)
        np.testing.assert_allclose(p_a[[0, 1]], [0, 0], atol=1e-6)
        np.testing.assert_allclose(p_c[2], gripper.contact_z_at(2 * along), atol=1e-6)
        tips = gripper.boxes(2 * along)[:, 1, 2].max()
        np.testing.assert_allclose(tips - p_c[2], gripper.tip_z - gripper.contact_z, atol=1e-6)
        assert abs(p_c[1]) < gripper.max_opening / 2
        assert p_a[2] > gripper.palm_z


def test_a_wider_gripper_takes_edges_that_a_narrow_one_cannot() -> None:
    cloud, pair = edge_cloud(0.045, 0.01), (np.array([0]), np.array([1]))
    found = {g.name: len(edge_grasps(cloud, *pair, g)) for g in GRIPPERS}
    assert found == {"panda": 0, "robotiq-2f-85": 0, "robotiq-2f-140": 1, "wsg-50": 1}


@by_name
def test_a_level_grasp_puts_its_contact_inside_the_fingertips(gripper: Any) -> None:
    floor = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.28)
    cloud = edge_cloud(0.02, 0.005)
    grasps = top_down_grasps(cloud, np.array([0]), np.array([1]), floor, gripper)
    assert len(grasps) == 1
    pose = grasps.T_cloud_hand[0]
    contact = (cloud.points[1] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(contact, [0, 0.02, gripper.contact_z_at(0.04)], atol=1e-6)


@by_name
def test_points_inside_any_box_collide_and_are_described(gripper: Any) -> None:
    boxes = gripper.boxes(gripper.max_opening)
    centres = boxes.mean(axis=1).astype(np.float32)
    between = np.array([[0.0, 0.0, gripper.contact_z]], np.float32)
    for point, hits in [(c[None], True) for c in centres] + [(between, False)]:
        cloud = Cloud(point, np.zeros_like(point))
        assert hits_cloud(cloud, HAND, gripper, Collision()).tolist() == [hits]
    cloud = edge_cloud(0.02, 0.01)
    pose = edge_grasps(cloud, np.array([0]), np.array([1]), gripper)
    points = centres @ pose.T_cloud_hand[0, :3, :3].T + pose.T_cloud_hand[0, :3, 3]
    seen = Cloud(np.vstack([cloud.points, points]), np.ones((2 + len(points), 3), np.float32))
    up = np.array([0.0, 0.0, 1.0], np.float32)
    described = describe_hands(seen, pose, gripper, up, None)[0]
    fingers, hands = len(gripper.finger_boxes), len(gripper.hand_boxes)
    # Centres of overlapping boxes lie in one region or the other, never in none.
    assert np.expm1(described[:2]).round().tolist() == [fingers, fingers]
    assert np.expm1(described[2]).round() >= hands


@by_name
def test_the_width_needed_reaches_past_what_stands_between_the_fingers(gripper: Any) -> None:
    point = np.array([[0.0, 0.01, gripper.contact_z]], np.float32)
    view = hand_views(Cloud(point, point), HAND, reach_of(gripper))
    assert 0.02 < required_openings(view, gripper)[0] <= gripper.max_opening


def test_a_bracket_beside_the_fingers_is_no_palm() -> None:
    fields = panda_fields()
    fields["hand"]["boxes"].append([[0.04, -0.02, 0.0], [0.09, 0.02, 0.1]])
    assert gripper_from_fields(fields).palm_z == 0.0658
    assert len(gripper_from_fields(fields).boxes(0.05)) == 4


def test_the_fields_of_a_request_make_the_gripper_of_the_file() -> None:
    fields = panda_fields()
    assert gripper_from_fields(fields) == load_gripper("panda")
    assert gripper_from_fields(GripperGeometry.model_validate(fields)) == load_gripper("panda")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["max_opening"], None, "max_opening: Field required"),
        (["max_opening"], "wide", "gripper.max_opening: got 'wide'"),
        (["max_opening"], 85.0, "less than or equal to 1"),
        (["max_opening"], float("nan"), "max_opening"),
        (["color"], "red", "gripper.color: Extra inputs"),
        (["tip_z"], 0.2, "highest z of finger.boxes"),
        (["contact_z"], 0.06, "contact_z must lie between the palm's z, 0.0658, and tip_z"),
        (["contact_z"], 0.2, "must hold the contact"),
        (["hand", "boxes"], [], "gripper.hand.boxes: got \\[\\]"),
        (["hand", "boxes"], [[[0, 0, 0], [0.1, -0.1, 0.1]]], "below that of max"),
        (["hand", "boxes"], [[[0.5, 0.5, 0.0], [0.6, 0.6, 0.06]]], "behind the space between"),
        (["finger", "boxes"], [[[-0.01, -0.01, 0.06], [0.01, 0.02, 0.1122]]], "no y below 0"),
        (["finger", "boxes"], [[[-0.01, 0.01, 0.06], [0.01, 0.02, 0.1122]]], "hold the contact"),
        (["swing"], {"radius": 0.01, "reach": 0.02}, "radius must exceed"),
    ],
)
def test_contradictory_fields_are_refused_by_name(
    path: list[str], value: Any, message: str
) -> None:
    fields = panda_fields()
    part = fields
    for name in path[:-1]:
        part = part[name]
    part[path[-1]] = value
    if value is None:
        del part[path[-1]]
    with pytest.raises(InvalidGripper, match=message):
        gripper_from_fields(fields)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("max_opening = 0.08", ""), "mine.toml: gripper.max_opening"),
        (("[hand]", "[hand"), "mine.toml"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, edit: tuple[str, str], message: str) -> None:
    text = (GRIPPER_FOLDER / "panda.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text)
    assert load_gripper(path) == load_gripper("panda")
    path.write_text(text.replace(*edit))
    with pytest.raises(InvalidGripper, match=message):
        load_gripper(path)


def test_an_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(
        InvalidGripper, match="'panda', 'robotiq-2f-140', 'robotiq-2f-85', 'wsg-50'"
    ):
        load_gripper("claw")
