"""Write the OpenAPI document of the HTTP transport.

usage: scripts/openapi.py [FOLDER]    writes openapi.json there, or into proto/
"""

import json
import sys
from pathlib import Path
from typing import Any

from edgegrasp_service.front.http import create_app

NAME = "openapi.json"


def document() -> str:
    """The document; nothing of a running server is in it."""
    nobody: Any = None
    app = create_app(nobody, nobody, nobody)
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "proto"
    (folder / NAME).write_text(document())
