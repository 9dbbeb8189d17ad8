"""`edgegrasp serve`, and `view`, which opens the playground of a local server."""

import json
import os
import shutil
import signal
import sys
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from edgegrasp_cli.flags import model_flags, takes_flags
from edgegrasp_service.settings import Settings, load_settings


@takes_flags(settings=model_flags(Settings, panel="Settings"))
def serve(
    config: Annotated[
        Path | None,
        Option(help="TOML file with settings: the flags' names, with _ for -.", metavar="FILE"),
    ] = None,
    print_config: Annotated[
        bool, Option("--print-config", help="Print the settings in effect as JSON, and stop.")
    ] = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Answer requests until SIGTERM; SIGHUP reloads weights, tokens and certificates.

    Prints one line with both addresses once weights are loaded. Settings without a flag come from
    EDGEGRASP_* environment variables, such as EDGEGRASP_HTTP_PORT, then from the file of --config,
    then from the defaults. Tokens come from files.
    """
    # gRPC's own log lines are not JSON, and a pipe that is not read would block it.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # until the server has its own handler
    loaded = load_settings(config, **settings)
    if print_config:
        print(loaded.model_dump_json(indent=2))
        return
    from edgegrasp_service.worker.process import ForkServer

    fork_server = ForkServer(loaded)  # it loads while this process imports the rest
    try:
        from edgegrasp_service.server import run

        run(loaded, fork_server)
    finally:
        fork_server.close()


def view(
    file: Annotated[
        Path | None, Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")
    ] = None,
    depth: Annotated[Path | None, Option(help="Depth image: 16-bit .png, or .npy.")] = None,
    intrinsics: Annotated[str | None, Option(help="Camera of --depth: fx,fy,cx,cy.")] = None,
    depth_scale: Annotated[
        float | None, Option(help="Metres per unit of --depth (0.001; for floats 1).")
    ] = None,
    color: Annotated[Path | None, Option(help="Colour image, same pixels: .png or .npy.")] = None,
    viewpoint: Annotated[str | None, Option(help="Camera position of a cloud: x,y,z.")] = None,
    browser: Annotated[bool, Option(help="Whether to open a browser.")] = True,
) -> None:
    """Look at a scene and its grasps in the browser; Ctrl-C ends it.

    An .npz file may also hold `depth`, `intrinsics` and `rgb`.
    """
    from rich.console import Console

    from edgegrasp_client.connection import local_server

    if file is not None and depth is not None:
        raise ValueError("give a cloud file, or --depth and --intrinsics")

    # SIGTERM from a supervisor ends it like Ctrl-C, together with its server.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    given = {"intrinsics": intrinsics, "depth_scale": depth_scale, "viewpoint": viewpoint}
    with tempfile.TemporaryDirectory() as folder:
        flags = []
        files = [each for each in (file, depth, color) if each is not None]
        if files:
            names = [f"{number}-{each.name}" for number, each in enumerate(files)]
            sample = {"name": files[0].name, "files": names}
            sample |= {name: str(value) for name, value in given.items() if value is not None}
            for each, name in zip(files, names, strict=True):
                shutil.copy(each, Path(folder) / name)
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
