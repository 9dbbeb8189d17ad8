"""Errors that the model and the pipeline raise, all EdgeGraspErrors."""

import reprlib
from collections.abc import Iterable

from edgegrasp_camera import EdgeGraspError as EdgeGraspError
from edgegrasp_camera import InvalidRequest as InvalidRequest


def brief(value: object) -> str:
    """A value shortened for an error message."""
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 8
_SHORT.maxdict = _SHORT.maxlist = _SHORT.maxtuple = 20  # members
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 90  # characters


class StartCollision(InvalidRequest):
    """In the request's joints the arm touches itself or the scene."""


class UnknownModel(InvalidRequest):
    """No weights of that name are loaded."""

    def __init__(self, name: str, known: Iterable[str]) -> None:
        fix = f"Use one of: {', '.join(sorted(known))}."
        super().__init__("options.model", brief(name), fix)


class InvalidCheckpoint(EdgeGraspError):  # noqa: N818
    """A weights file cannot be used: truncated, foreign, or of another architecture."""


class InvalidGripper(EdgeGraspError):  # noqa: N818
    """A gripper file cannot be used."""


class InvalidDevice(InvalidRequest):
    """The device to compute on does not exist."""
