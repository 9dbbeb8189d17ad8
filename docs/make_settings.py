"""Writes the table of docs/settings.md: `python docs/make_settings.py`."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pages import filled, table

from edgegrasp_service.settings import Settings

PAGE = Path(__file__).parent / "settings.md"


def page() -> str:
    """The whole page."""
    head = ("setting", "default", "range", "meaning")
    return filled(PAGE.read_text(), {"settings": table(head, rows())})


def rows() -> Iterator[list[str]]:
    """Cells of the table."""
    for name, field in Settings.model_json_schema()["properties"].items():
        default = field.get("default")
        shown = "none" if default in (None, [], "") else f"`{json.dumps(default)}`"
        yield [f"`{name}`", shown, _range(field), field["description"]]


def _range(field: dict[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{word}`" for word in field["enum"])
    low = field.get("minimum", field.get("exclusiveMinimum"))
    high = field.get("maximum")
    above = "above " if "exclusiveMinimum" in field else ""
    if low is None:
        return ""
    return f"{above}{low:g} and more" if high is None else f"{above}{low} to {high}"


if __name__ == "__main__":
    PAGE.write_text(page())
