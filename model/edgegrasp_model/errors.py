"""Errors that the model and the pipeline raise, all EdgeGraspErrors."""

import reprlib
from collections.abc import Iterable
from itertools import islice
from typing import Any

from edgegrasp_camera import EdgeGraspError as EdgeGraspError
from edgegrasp_camera import InvalidRequest as InvalidRequest


def brief(value: object) -> str:
    """A value shortened for an error message."""
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 8
        self.maxdict = self.maxlist = self.maxtuple = 20  # members
        self.maxstring = self.maxlong = self.maxother = 90  # characters

    def repr_dict(self, value: dict[Any, Any], level: int) -> str:
        """In insertion order; the base class sorts."""
        if level <= 0:
            return "{...}"
        members = [
            f"{self.repr1(name, level - 1)}: {self.repr1(part, level - 1)}"
            for name, part in islice(value.items(), self.maxdict)
        ]
        return "{" + ", ".join(members + ["..."] * (len(value) > self.maxdict)) + "}"


_SHORT = _Short()


class StartCollision(InvalidRequest):
    """In the request's joints the arm touches itself or the scene."""


class UnknownModel(EdgeGraspError):  # noqa: N818
    """No weights of that name are loaded."""

    def __init__(self, name: str, known: Iterable[str]) -> None:
        self.name = name
        self.known = sorted(known)
        super().__init__(
            f"model: got {brief(name)}. Use one of: {', '.join(self.known) or 'none loaded'}."
        )


class InvalidCheckpoint(EdgeGraspError):  # noqa: N818
    """A weights file cannot be used: truncated, foreign, or of another architecture."""


class InvalidGripper(EdgeGraspError):  # noqa: N818
    """A gripper file cannot be used."""


class InvalidDevice(EdgeGraspError):  # noqa: N818
    """The requested device does not exist; `fix` is an imperative sentence."""

    def __init__(self, name: str, fix: str) -> None:
        super().__init__(f"device: got {brief(name)}. {fix}")
