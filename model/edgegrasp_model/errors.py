"""Errors that the model and the pipeline raise, all EdgeGraspErrors, and their messages."""

import reprlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from edgegrasp_camera import EdgeGraspError as EdgeGraspError
from edgegrasp_camera import InvalidRequest as InvalidRequest

Schema = TypeVar("Schema", bound=BaseModel)


def parse(schema: type[Schema], fields: object, name: str) -> Schema:
    """Validate plain values with a schema; raises InvalidRequest, which names a field of `name`."""
    try:
        return schema.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    kind, fix = first["type"], first["msg"].removeprefix("Value error, ")
    path = _path(first["loc"], fields, kind in ("missing", "extra_forbidden"))
    field = ".".join([name, *path])
    if kind == "extra_forbidden":
        there = f"; the fields are: {', '.join(schema.model_fields)}" if len(path) == 1 else ""
        raise InvalidRequest(field, "an unknown field", f"Remove it{there}.")
    value = "nothing" if kind == "missing" else brief(first["input"])
    if value.startswith(("'", "b'")) and field.endswith(".data"):
        raise InvalidRequest(field, "invalid base64", "Send base64 in JSON.")
    if kind == "union_tag_invalid":
        fix = f"Set its kind to one of {first['ctx']['expected_tags']}"
    if kind == "model_type":
        fix = f"Send an object as {first['ctx']['class_name']}"
    if kind == "tuple_type":
        fix = "Send a list"
    if kind in ("too_short", "too_long"):  # "Tuple should have at least 3 items after validation"
        fix = "Send" + fix.partition(" should have")[2].partition(" after")[0]
    if kind in ("union_tag_not_found", "model_attributes_type"):
        fix = "Send an object that names its kind"
    raise InvalidRequest(field, value, f"{fix[:1].upper()}{fix[1:]}.")


def _path(location: Sequence[str | int], fields: object, named: bool) -> list[str]:
    """A location without the names of union members; `named`: the last part is a field's name."""
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


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 8
_SHORT.maxdict = _SHORT.maxlist = _SHORT.maxtuple = 20  # members
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 90  # characters


class StartCollision(InvalidRequest):
    """The arm touches itself or the scene at the request's joints."""


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
