"""Which gripper a request is about."""

from collections.abc import Mapping

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import (
    Gripper,
    GripperGeometry,
    gripper_from_fields,
    gripper_names,
    load_gripper,
)
from edgegrasp_model.options import DetectOptions


def chosen_gripper(options: DetectOptions, default: Gripper, own: Mapping[str, Gripper]) -> Gripper:
    """The gripper a request asks for, opened as far as it asks for.

    Args:
        options: gripper and collision.opening.
        default: Used where the request names none.
        own: A user's own, by name; they win over those that ship.

    Raises:
        InvalidRequest: There is none of that name, or it does not open that far.
    """
    asked = options.gripper
    if asked is None:
        gripper = default
    elif isinstance(asked, GripperGeometry):
        gripper = gripper_from_fields(asked)
    elif asked in own:
        gripper = own[asked]
    elif asked in gripper_names():  # a request must not name a file
        gripper = load_gripper(asked)
    else:
        known = ", ".join(sorted({*own, *gripper_names()}))
        fix = f"Use one of: {known}; or send the gripper itself."
        raise InvalidRequest("options.gripper", repr(asked), fix)
    opening = options.collision.opening
    if opening is None:
        return gripper
    if opening > gripper.max_opening:
        fix = f"Send at most {gripper.max_opening:g} for the gripper {gripper.name!r}."
        raise InvalidRequest("options.collision.opening", f"{opening:g} m", fix)
    return gripper.opened_to(opening)
