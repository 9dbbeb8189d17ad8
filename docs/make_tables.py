"""Writes the table of docs/settings.md from the server's settings: `python docs/make_tables.py`."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgegrasp_service.settings import Settings

PAGE = Path(__file__).parent / "settings.md"
BLOCK = re.compile(r"(<!-- begin: settings -->\n).*?(<!-- end -->)", re.DOTALL)


def pages() -> dict[Path, str]:
    """The text of the page with its table."""
    lines = [["setting", "default", "range", "meaning"], ["---"] * 4]
    for name, field in Settings.model_json_schema()["properties"].items():
        default = field.get("default")
        shown = "none" if default in (None, [], "") else f"`{json.dumps(default)}`"
        lines.append([f"`{name}`", shown, _range(field), field["description"]])
    table = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return {PAGE: BLOCK.sub(lambda match: f"{match[1]}\n{table}\n{match[2]}", PAGE.read_text())}


def _range(field: Mapping[str, Any]) -> str:
    if "enum" in field:
        return ", ".join(f"`{word}`" for word in field["enum"])
    low = field.get("minimum", field.get("exclusiveMinimum"))
    high = field.get("maximum")
    above = "above " if "exclusiveMinimum" in field else ""
    if low is None:
        return ""
    return f"{above}{low:g} and more" if high is None else f"{above}{low} to {high}"


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text)
