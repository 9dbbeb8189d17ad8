"""Grippers from files and requests, and what each of them makes of edges and points."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from tests.checks import refusal
from tests.many_options import OWN_GRIPPER

from edgegrasp_model import gripper as grippers
from edgegrasp_model.candidates import edge_grasps as edges
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
from edgegrasp_model.errors import InvalidGripper
from edgegrasp_model.options import DetectOptions, GripperGeometry, SupportPlane

from .scenes import PANDA, VIEW, box_on_table, detector

PANDA_FILE = (grippers.GRIPPER_FOLDER / "panda.toml").read_text()
GRIPPERS = [grippers.load_gripper(name) for name in grippers.gripper_names()]
by_name = pytest.mark.parametrize("gripper", GRIPPERS, ids=lambda gripper: gripper.name)


@by_name
def test_a_gripper_stays_clear_of_the_support_as_it_closes(gripper: grippers.Gripper) -> None:
    down = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)[None]
    down[0, 2, 3] = 0.5
    floor = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)
    for opening in (0.0, 0.03, 0.06, 0.085):
        clearance = edges.support_clearance(down, np.float32([opening]), floor, gripper)[0]
        closed = np.linspace(max(opening - edges.CLOSING_ALLOWANCE, 0.0), gripper.max_opening, 80)
        lowest = min(0.5 - gripper.boxes(w)[:, 1, 2].max() for w in closed)
        assert clearance == pytest.approx(lowest, abs=2e-5)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_hand_with_a_camera_at_one_side_is_turned_away_from_a_wall(side: int) -> None:
    fields = tomllib.loads(PANDA_FILE) | {"contact_z": 0.1115}  # nearly at the tips
    camera = np.sort([[side * 0.0316, -0.03, 0.0], [side * 0.12, 0.03, 0.085]], axis=0)
    fields["hand"]["boxes"].append(camera.tolist())
    box = box_on_table(size=(0.04, 0.3, 0.03))
    wall = {"kind": "box", "min": [-1, 0.155, 0.05], "max": [1, 0.3, 0.3]}
    asked = {"gripper": fields, "support": {"normal": (0, 0, 1), "offset": 0.0}, "viewpoint": VIEW}
    region = {"include": [{"kind": "box", "min": [-1, 0.11, 0], "max": [1, 0.15, 1]}]}
    asked |= {"collision": {"obstacles": [wall]}, "approach_region": region, "min_score": 0.0}
    found = detector().detect(box, DetectOptions.model_validate(asked | {"top_k": 1000}))
    ways = {round(float(one.T_cloud_hand[1, 0])) for one in found.grasps}
    assert ways == {-side}


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
        (["contact_z"], 0.2, "must contain the contact"),
        (["hand", "boxes"], [], "gripper.hand.boxes: got \\[\\]"),
        (["hand", "boxes"], [[[0, 0, 0], [0.1, -0.1, 0.1]]], "below that of max"),
        (["hand", "boxes"], [[[0.5, 0.5, 0.0], [0.6, 0.6, 0.06]]], "behind the space between"),
        (["finger", "boxes"], [[[-0.01, -0.01, 0.06], [0.01, 0.02, 0.1122]]], "no y below 0"),
        (["finger", "boxes"], [[[-0.01, 0.01, 0.06], [0.01, 0.02, 0.1122]]], "contain the contact"),
        (["swing"], {"radius": 0.01, "reach": 0.02}, "radius must exceed"),
    ],
)
def test_contradictory_fields_of_a_gripper_are_refused_by_name(path, value, message) -> None:
    fields = part = tomllib.loads(PANDA_FILE)
    for name in path[:-1]:
        part = part[name]
    part[path[-1]] = value
    if value is None:
        del part[path[-1]]
    with pytest.raises(InvalidGripper, match=message):
        grippers.gripper_from_fields(fields)


def test_a_file_and_a_request_make_the_same_gripper_and_a_broken_file_is_refused(tmp_path) -> None:
    asked = GripperGeometry.model_validate(tomllib.loads(PANDA_FILE))
    assert grippers.gripper_from_fields(asked) == PANDA
    path = tmp_path / "mine.toml"
    path.write_text(PANDA_FILE)
    assert grippers.load_gripper(path) == PANDA
    for old, new, message in (
        ("max_opening = 0.08", "", "mine.toml: gripper.max_opening"),
        ("[hand]", "[hand", "mine.toml"),
    ):
        path.write_text(PANDA_FILE.replace(old, new))
        with pytest.raises(InvalidGripper, match=message):
            grippers.load_gripper(path)
    with pytest.raises(InvalidGripper, match="'panda', 'robotiq-2f-140'"):
        grippers.load_gripper("claw")


def choose(own: dict[str, object] | None = None, **fields: object) -> object:
    return grippers.choose_gripper(DetectOptions.model_validate(fields), PANDA, own or {})


def test_a_gripper_is_chosen_by_nothing_a_known_name_or_fields() -> None:
    assert choose() is PANDA
    mine = grippers.load_gripper("wsg-50")
    assert choose(gripper="wsg-50") == mine
    assert choose({"panda": mine}, gripper="panda") is mine
    custom = choose(gripper=OWN_GRIPPER)
    assert (custom.name, custom.max_opening, custom.palm_z) == ("custom", 0.07, 0.05)
    for fields, field, fix in (
        ({"gripper": "hook"}, "options.gripper", "robotiq-2f-85"),
        ({"gripper": "../grippers/panda.toml"}, "options.gripper", "Use one of"),
        ({"collision": {"opening": 0.081}}, "options.collision.opening", "at most 0.08"),
    ):
        with refusal(field, fix=fix):
            choose(**fields)


@by_name
def test_grasps_fit_the_gripper_that_was_asked_for(gripper: grippers.Gripper) -> None:
    whole = {"viewpoint": VIEW, "support": None, "suppression": None}
    options = DetectOptions(gripper=gripper.name, num_approach_points=12, **whole)
    found = detector().detect(box_on_table(), options)
    assert found.grasps
    for grasp in found.grasps:
        T_hand_tcp = np.linalg.inv(grasp.T_cloud_hand) @ grasp.T_cloud_tcp
        np.testing.assert_allclose(T_hand_tcp, gripper.T_hand_tcp, atol=1e-5)
        contact = (grasp.contact_point - grasp.T_cloud_hand[:3, 3]) @ grasp.T_cloud_hand[:3, :3]
        further_in = gripper.contact_z_at(2 * abs(contact[1])) - contact[2]
        shallowest = gripper.contact_z - gripper.tip_z + edges.FIT_MARGIN
        assert shallowest - 1e-3 < further_in < edges.MAX_INSERTION + 2e-3
        assert grasp.width <= np.float32(gripper.max_opening)
    warned = any("trained for the gripper 'panda'" in warning for warning in found.warnings)
    assert warned == (gripper.name != "panda")


def test_weights_trained_with_many_hands_warn_about_no_gripper(catalogue: ModelCatalogue) -> None:
    of_one = detector()
    metadata = replace(of_one.metadata, training={"training_hands": 400})
    of_many = GraspDetector(of_one.network, metadata)
    found = of_many.detect(box_on_table(), DetectOptions(viewpoint=VIEW, gripper="wsg-50"))
    assert found.grasps
    assert not any("trained for" in warning for warning in found.warnings)
    options = DetectOptions(viewpoint=VIEW, support=None, gripper="wsg-50")
    warned = [  # only the default weights were
        row["name"]
        for row in catalogue.describe()
        if catalogue.get(row["name"]).detect(box_on_table(), options).warnings
    ]
    assert warned == ["edgegrasp", "edgegrasp-small", "vn-edgegrasp"]


def test_a_wider_gripper_reaches_contacts_beyond_the_ball_of_the_weights() -> None:
    whole = {"viewpoint": VIEW, "support": None, "suppression": None, "collision": "ignore"}
    for name, least, most in (("panda", 0.0, 0.045), ("robotiq-2f-140", 0.045, 0.07)):
        options = DetectOptions(gripper=name, top_k=2000, **whole)
        grasps = detector().detect(box_on_table(), options).grasps
        longest = max(np.linalg.norm(g.approach_point - g.contact_point) for g in grasps)
        assert least < longest < most
