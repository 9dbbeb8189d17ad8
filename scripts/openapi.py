"""Write the OpenAPI document of the HTTP transport.

usage: scripts/openapi.py [FOLDER]    writes openapi.json there, or into proto/
"""

import asyncio
import json
import sys
from pathlib import Path

from edgegrasp_service.front.http import create_app
from edgegrasp_service.server import Server
from edgegrasp_service.settings import Settings

NAME = "openapi.json"


async def document() -> str:
    """The document; no limit of a server is in it."""
    server = Server(Settings(backend="dummy"))
    app = create_app(server.service, server.metrics, server.reloader)
    return json.dumps(app.openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1] / "proto"
    (folder / NAME).write_text(asyncio.run(document()))
