"""Options written as text in query parameters."""

import json
from collections.abc import Iterable

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions


def options_from_query(items: Iterable[tuple[str, str]]) -> dict[str, object]:
    """Decode query parameters, or what the command line takes; one an option.

    A value is JSON (`seed=3`, `suppression=null`, `workspace={"min":[0,0,0],"max":[1,1,1]}`),
    numbers between commas (`viewpoint=0.1,0.2,0.3`), or else the text itself
    (`sampling=uniform`).

    Raises:
        InvalidRequest: A parameter stands there twice.
    """
    options: dict[str, object] = {}
    for name, text in items:
        if name in options:
            raise InvalidRequest(f"options.{name}", "two values", "Send it once.")
        options[name] = _value(name, text)
    return options


def _value(name: str, text: str) -> object:
    field = DetectOptions.model_fields.get(name)
    if field is not None and field.annotation is str:
        return text  # weights may be named 7 or null
    if name == "gripper" and not text.startswith(("{", "[")) and text != "null":
        return text  # as may grippers
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        pass
    if "," in text:
        try:
            return [float(part) for part in text.split(",")]
        except ValueError:
            pass
    return text
