"""`edgegrasp serve`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

Option = typer.Option


def serve(
    host: Annotated[str | None, Option(help="Address to bind to.")] = None,
    http_port: Annotated[int | None, Option(help="0: any free port.")] = None,
    grpc_port: Annotated[int | None, Option(help="0: any free port.")] = None,
    weights: Annotated[
        list[Path] | None, Option(help="Weights file or folder, besides those that ship.")
    ] = None,
    grippers: Annotated[
        list[Path] | None, Option(help="Gripper file (.toml), besides those that ship.")
    ] = None,
    default_model: Annotated[
        str | None, Option(help="Weights used when a request names none.")
    ] = None,
    max_body_bytes: Annotated[int | None, Option(help="Largest request body accepted.")] = None,
    max_points: Annotated[int | None, Option(help="Most points in a cloud.")] = None,
    grace_seconds: Annotated[
        float | None, Option(help="Time for requests in flight when stopping.")
    ] = None,
    backend: Annotated[
        str | None, Option(help="weights, or dummy: made-up grasps for load tests.")
    ] = None,
    dummy_seconds: Annotated[
        float | None, Option(help="Service time of the dummy backend.")
    ] = None,
    log_level: Annotated[str | None, Option(help="debug, info, warning or error.")] = None,
) -> None:
    """Answer requests over HTTP and gRPC until SIGTERM.

    Prints one line with both addresses once weights are loaded. What no flag sets comes from
    EDGEGRASP_* environment variables, such as EDGEGRASP_HTTP_PORT, or else from the defaults:
    127.0.0.1, ports 8000 and 50051.
    """
    given = {name: value for name, value in locals().items() if value not in (None, [])}
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_service.server import run
    from edgegrasp_service.settings import load_settings

    try:
        run(load_settings(**given))
    except EdgeGraspError as error:
        sys.exit(f"edgegrasp serve: {error}")
