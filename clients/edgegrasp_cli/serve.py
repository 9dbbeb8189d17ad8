"""`edgegrasp serve`: every setting of the server is a flag."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from edgegrasp_cli.flags import model_flags, takes_flags
from edgegrasp_service.settings import Settings


@takes_flags(settings=model_flags(Settings, panel="Settings"))
def serve(
    config: Annotated[
        Path | None,
        typer.Option(help="TOML file with settings, named as here with _ for -.", metavar="FILE"),
    ] = None,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="Print the settings in effect as JSON, and stop.")
    ] = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Answer requests until SIGTERM; SIGHUP reloads weights, tokens and certificates.

    Prints one line with both addresses once weights are loaded. What no flag sets comes from
    EDGEGRASP_* environment variables, such as EDGEGRASP_HTTP_PORT, then from the file of --config,
    or else from the defaults. Tokens come from files.
    """
    # gRPC's own log lines are not JSON, and a pipe that is not read would block it.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from edgegrasp_service.settings import load_settings

    loaded = load_settings(config, **settings)
    if print_config:
        print(loaded.model_dump_json(indent=2))
        return
    from edgegrasp_service.server import run

    run(loaded)
