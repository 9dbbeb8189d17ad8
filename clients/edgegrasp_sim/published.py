"""What papers report, to stand beside our own figures."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

PUBLISHED = Path(__file__).parent / "published.toml"


def published(protocol: str, scene: str, samples: str | None = None) -> list[dict[str, Any]]:
    """The published results of a protocol and scene, in the file's order; rates in per cent.

    Args:
        protocol: its name; a variant, named `<protocol>-<variant>`, has the figures of both.
        scene: kind of the scenes.
        samples: only those at these approach points and candidates, such as `32-2k`.
    """
    rows: list[dict[str, Any]] = tomllib.loads(PUBLISHED.read_text())["result"]
    return [
        row
        for row in rows
        if f"{protocol}-".startswith(f"{row['protocol']}-")
        and row["scene"] == scene
        and samples in (None, row.get("samples"))
    ]
