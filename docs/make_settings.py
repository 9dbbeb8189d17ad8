"""Writes docs/settings.md from the settings of the server: `python docs/make_settings.py`."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edgegrasp_service.settings import SECRETS, Settings

PAGE = Path(__file__).parent / "settings.md"
INTRODUCTION = """\
# Settings

What `edgegrasp serve` can be told. Each has one name everywhere, and the later source wins:

1. the default;
2. a TOML file, `http_port = 8080`: the one `--config FILE` or `EDGEGRASP_CONFIG` names. Its paths
   are relative to its own folder;
3. an environment variable, `EDGEGRASP_HTTP_PORT=8080`; lists as JSON;
4. a flag, `--http-port 8080`; lists by repeating it.

A name that is no setting is an error that suggests the nearest one, wherever it stands.
`edgegrasp serve --print-config` prints what is in effect and where each value came from, as a TOML
file that gives the same settings again; secrets are left out of it. Tokens have no flags: the
command lines of a machine are open to all its users.

| setting | default | range | meaning |
| --- | --- | --- | --- |
"""
END = """
This page is written from the settings by `python docs/make_settings.py`.
"""


def page() -> str:
    """The whole page."""
    return INTRODUCTION + "".join(f"| {' | '.join(row)} |\n" for row in rows()) + END


def rows() -> Iterator[list[str]]:
    """Cells of the table."""
    properties = Settings.model_json_schema()["properties"]
    for name, field in properties.items():
        default = field.get("default")
        shown = "none" if default in (None, [], "") else f"`{json.dumps(default)}`"
        words = field["description"] + (" (no flag)" if name in SECRETS else "")
        yield [f"`{name}`", shown, _range(field), words]


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
