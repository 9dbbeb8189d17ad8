"""Errors that the model and the pipeline raise, all EdgeGraspErrors."""

import reprlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

from pydantic import ValidationError

from edgegrasp_camera import EdgeGraspError as EdgeGraspError
from edgegrasp_camera import InvalidRequest as InvalidRequest


def invalid_fields(
    error: ValidationError, fields: object, prefix: str, known: Iterable[str] = ()
) -> InvalidRequest:
    """The first fault of pydantic in fields under `prefix`; top-level fields `known` are listed."""
    first = error.errors(include_url=False)[0]
    named = first["type"] in ("missing", "extra_forbidden")
    path = _path(first["loc"], fields, named)
    field = ".".join([prefix, *path])
    if first["type"] == "extra_forbidden":
        there = f"; the {prefix} are: {', '.join(known)}" if len(path) == 1 and known else ""
        return InvalidRequest(field, "an unknown field", f"Remove it{there}.")
    value = "nothing" if first["type"] == "missing" else brief(first["input"])
    fix = first["msg"].removeprefix("Value error, ")
    if first["type"] == "union_tag_invalid":
        fix = f"Set its kind to one of {first['ctx']['expected_tags']}"
    if first["type"] == "union_tag_not_found":
        fix = "Send an object that names its kind"
    return InvalidRequest(field, value, f"{fix[:1].upper()}{fix[1:]}.")


def _path(location: Sequence[str | int], fields: object, named: bool) -> list[str]:
    """A location without names of unions' members; `named`: the last part is a field's name."""
    path: list[str] = []
    here: Any = fields
    for place, part in enumerate(location):
        if isinstance(part, int):
            here = here[part] if isinstance(here, (list, tuple)) and part < len(here) else None
        elif isinstance(here, Mapping) and part in here:
            here = here[part]
        elif not (named and place == len(location) - 1):
            continue
        path.append(str(part))
    return path


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
