"""Counts the functions and files of the project that one JSON request enters.

usage: python scripts/trace_request.py [--list]

The server's front runs in this process with real workers; the worker's part is run again here, so
that both are traced. A depth image of the samples is sent; what is loaded at the start, or goes on
from before, is left out.
"""

import asyncio
import json
import sys
from pathlib import Path
from types import FrameType

import httpx
import numpy as np
from PIL import Image

from edgegrasp_service.server import Server
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.answer import answer, load_catalogue
from edgegrasp_service.worker.process import Job

ROOT, JSON = Path(__file__).parents[1], "application/json"
entered: set[tuple[str, str]] = set()  # file and function


def note(frame: FrameType, event: str, _: object) -> None:
    """Keep a function of the project that is called."""
    file, name = Path(frame.f_code.co_filename), frame.f_code.co_qualname
    ours = any(file.is_relative_to(ROOT / folder) for folder in ("clients", "model", "service"))
    if event != "call" or not ours or name.endswith(">"):  # no lambda, no comprehension
        return
    if frame.f_code.co_code[frame.f_lasti + 1] == 0:  # of RESUME: not after an await
        entered.add((str(file.relative_to(ROOT)), name))


async def send(body: bytes, settings: Settings) -> None:
    """Send the body to a server in this process."""
    stop, ready = asyncio.Event(), asyncio.Event()
    server = Server(settings)
    serving = asyncio.create_task(server.serve(stop, ready=ready.set))
    await ready.wait()
    async with httpx.AsyncClient(base_url=server.http_url, timeout=120) as client:
        sys.setprofile(note)
        response = await client.post("/v1/grasps", content=body, headers={"content-type": JSON})
        sys.setprofile(None)
    stop.set()
    await serving
    response.raise_for_status()


def main() -> None:
    depth = (np.asarray(Image.open(ROOT / "examples/sample/depth.png")) / 1000).tolist()
    image = {"depth": depth, "intrinsics": [540, 540, 320, 239]}
    body = json.dumps({"depth_images": [image]}).encode()
    settings = Settings(http_port=0, grpc_port=0, workers=1)
    asyncio.run(send(body, settings))
    catalogue = load_catalogue(settings)
    sys.setprofile(note)
    found = answer(Job("DetectGrasps", "http", body, 120.0, JSON), catalogue, settings)
    sys.setprofile(None)
    assert found.error is None, found.error
    files = sorted({file for file, _ in entered})
    if "--list" in sys.argv:
        print("\n".join(f"{file}: {name}" for file, name in sorted(entered)))
    print(f"{len(entered)} functions in {len(files)} files; {found.facts.grasps} grasps")


if __name__ == "__main__":
    main()
