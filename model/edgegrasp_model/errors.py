"""Errors the model and the pipeline raise.

EdgeGraspError
  + InvalidRequest        the caller's input is wrong: names the field, the value and the fix
  + UnknownModel          no weights of that name are loaded
  + InvalidCheckpoint     a weights file cannot be used
  + InvalidGripper        a gripper file cannot be used
  + InvalidDevice         the device to compute on is not there
"""

import reprlib
from collections.abc import Iterable
from itertools import islice
from typing import Any


class EdgeGraspError(Exception):
    """Base of every error this package raises on purpose."""


class InvalidRequest(EdgeGraspError):  # noqa: N818
    """The caller's input is wrong.

    Args:
        field: Name of the request field, as it is spelled on the wire (`cloud`, `options.seed`).
        value: What was received, short enough to print.
        fix: What to send instead, as an imperative sentence.
    """

    def __init__(self, field: str, value: str, fix: str) -> None:
        self.field = field
        self.value = value
        self.fix = fix
        super().__init__(f"{field}: got {value}. {fix}")


def brief(value: object) -> str:
    """A value as it goes into an error: short, however long or deep it is."""
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 8
        self.maxdict = self.maxlist = self.maxtuple = 20  # members
        self.maxstring = self.maxlong = self.maxother = 90  # characters

    def repr_dict(self, value: dict[Any, Any], level: int) -> str:
        """In the order it came in, which the base class changes."""
        if level <= 0:
            return "{...}"
        members = [
            f"{self.repr1(name, level - 1)}: {self.repr1(part, level - 1)}"
            for name, part in islice(value.items(), self.maxdict)
        ]
        return "{" + ", ".join(members + ["..."] * (len(value) > self.maxdict)) + "}"


_SHORT = _Short()


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
    """The device to compute on is not there.

    Args:
        name: What was asked for.
        fix: What to ask for instead, as an imperative sentence.
    """

    def __init__(self, name: str, fix: str) -> None:
        super().__init__(f"device: got {brief(name)}. {fix}")
