"""`edgegrasp view`: the playground of a server of one's own, with a scene of one's own in it."""

import json
import shutil
import signal
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from edgegrasp_cli.detect import Cloud, Color, DepthScale

Option = typer.Option


def view(
    file: Cloud = None,
    depth: Annotated[Path | None, Option(help="Depth image in place of a cloud: .png.")] = None,
    intrinsics: Annotated[str | None, Option(help="Camera of --depth: fx,fy,cx,cy.")] = None,
    depth_scale: DepthScale = None,
    color: Color = None,
    viewpoint: Annotated[str | None, Option(help="Camera position of a cloud: x,y,z.")] = None,
    browser: Annotated[bool, Option(help="Open a browser, besides printing the address.")] = True,
) -> None:
    """Look at a scene and its grasps in the browser; Ctrl-C ends it.

    An .npz file may also hold `depth`, `intrinsics` and `rgb`.
    """
    from rich.console import Console

    from edgegrasp_client.local_server import local_server

    # A supervisor ends it as Ctrl-C does, also in the background: its server goes with it.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    given = {"intrinsics": intrinsics, "depth_scale": depth_scale, "viewpoint": viewpoint}
    with tempfile.TemporaryDirectory() as folder:
        flags = []
        files = [each for each in (file, depth, color) if each is not None]
        if files:
            sample = {"name": files[0].name, "files": [each.name for each in files]}
            sample |= {name: str(value) for name, value in given.items() if value is not None}
            for each in files:
                shutil.copy(each, folder)
            (Path(folder) / "samples.json").write_text(json.dumps([sample]))
            flags = ["--samples", folder]
        starting = "Starting a server; the first one compiles for a minute…"
        with Console(stderr=True).status(starting) as status, local_server(*flags) as own:
            status.stop()
            print(f"{own.http_url}/playground/ (Ctrl-C ends it)", flush=True)
            if browser:
                webbrowser.open(f"{own.http_url}/playground/")
            with suppress(KeyboardInterrupt):
                signal.pause()
