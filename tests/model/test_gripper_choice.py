from collections.abc import Callable

import numpy as np
import pytest

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import choose_gripper, gripper_names, load_gripper
from edgegrasp_model.options import DetectOptions

PANDA = load_gripper("panda")


def choose(own: dict[str, object] | None = None, **fields: object) -> object:
    return choose_gripper(DetectOptions.model_validate(fields), PANDA, own or {})


def test_none_is_the_default_a_name_a_file_and_an_object_itself() -> None:
    assert choose() is PANDA
    assert choose(gripper="wsg-50") == load_gripper("wsg-50")
    mine = load_gripper("robotiq-2f-85")
    assert choose({"panda": mine}, gripper="panda") is mine
    fields = {
        "max_opening": 0.05,
        "tip_z": 0.1,
        "contact_z": 0.09,
        "tcp_z": 0.09,
        "hand": {"boxes": [[[-0.03, -0.05, 0.0], [0.03, 0.05, 0.06]]]},
        "finger": {"boxes": [[[-0.01, 0.0, 0.06], [0.01, 0.02, 0.1]]]},
    }
    custom = choose(gripper=fields)
    assert (custom.name, custom.max_opening, custom.palm_z) == ("custom", 0.05, 0.06)


@pytest.mark.parametrize(
    ("fields", "field", "fix"),
    [
        ({"gripper": "hook"}, "options.gripper", "robotiq-2f-85"),
        ({"gripper": "../grippers/panda.toml"}, "options.gripper", "Use one of"),
        ({"collision": {"opening": 0.081}}, "options.collision.opening", "at most 0.08"),
    ],
)
def test_what_there_is_not_is_refused(fields: dict[str, object], field: str, fix: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        choose(**fields)
    assert caught.value.field == field
    assert fix in caught.value.fix


@pytest.mark.parametrize("name", gripper_names())
@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_a_gripper_that_opens_less_is_the_same_one_half_closed(name: str, share: float) -> None:
    full = load_gripper(name)
    opening = share * full.max_opening
    part = choose(gripper=name, collision={"opening": opening})
    for narrower in (opening, 0.5 * opening, 0.0):
        np.testing.assert_allclose(part.boxes(narrower), full.boxes(narrower), atol=1e-9)
        np.testing.assert_allclose(part.contact_z_at(narrower), full.contact_z_at(narrower))
    np.testing.assert_allclose(part.tip_z, part.boxes(opening)[:, 1, 2].max())


@pytest.mark.parametrize("name", gripper_names())
def test_grasps_fit_the_gripper_that_was_asked_for(
    name: str, plus: GraspDetector, box_on_table: Callable[..., np.ndarray]
) -> None:
    options = DetectOptions(
        viewpoint=(0.3, 0.2, 0.5), gripper=name, num_approach_points=12, suppression=None
    )
    found = plus.detect(box_on_table(count=2000), options)
    gripper = load_gripper(name)
    assert found.grasps
    for grasp in found.grasps:
        np.testing.assert_allclose(
            np.linalg.inv(grasp.T_cloud_hand) @ grasp.T_cloud_tcp, gripper.T_hand_tcp, atol=1e-5
        )
        contact = (grasp.contact_point - grasp.T_cloud_hand[:3, 3]) @ grasp.T_cloud_hand[:3, :3]
        np.testing.assert_allclose(contact[2], gripper.contact_z_at(2 * abs(contact[1])), atol=1e-5)
        assert grasp.width <= np.float32(gripper.max_opening)
    told = any("trained for the gripper 'panda'" in warning for warning in found.warnings)
    assert told == (name != "panda")


def test_a_wider_gripper_reaches_further_contacts(
    plus: GraspDetector, box_on_table: Callable[..., np.ndarray]
) -> None:
    def longest(name: str) -> float:
        options = DetectOptions(
            viewpoint=(0.3, 0.2, 0.5),
            gripper=name,
            collision="ignore",
            suppression=None,
            top_k=2000,
        )
        grasps = plus.detect(box_on_table(count=2000), options).grasps
        return max(float(np.linalg.norm(g.approach_point - g.contact_point)) for g in grasps)

    assert longest("panda") < 0.038
    assert longest("robotiq-2f-140") > 0.045  # beyond the ball the weights were trained on
