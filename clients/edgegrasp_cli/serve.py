"""`edgegrasp serve`: every setting of the server but its secrets is a flag."""

import inspect
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer

from edgegrasp_service.settings import SECRETS, Settings

Option = typer.Option


def serve(config: Path | None, print_config: bool, **flags: Any) -> None:
    """Answer requests until SIGTERM; SIGHUP reloads weights, tokens and certificates.

    Prints one line with both addresses once weights are loaded. What no flag sets comes from
    EDGEGRASP_* environment variables, such as EDGEGRASP_HTTP_PORT, then from the file of --config,
    or else from the defaults. Tokens come from files, or EDGEGRASP_TOKENS.
    """
    given = {name: value for name, value in flags.items() if value not in (None, [])}
    # gRPC's own lines are no JSON, and a pipe that nobody reads would stop it: no lines.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_service.settings import load_settings_and_origins

    try:
        settings, origins = load_settings_and_origins(config, **given)
        if print_config:
            from edgegrasp_service.settings import config_text

            print(config_text(settings, origins), end="")
            return
        from edgegrasp_service.server import run

        run(settings)
    except EdgeGraspError as error:
        sys.exit(f"edgegrasp serve: {error}")


def _parameters() -> Iterator[inspect.Parameter]:
    """What typer makes flags of: two of the command's own, and the settings."""
    config = Option(help="TOML file with settings, named as here with _ for -.", metavar="FILE")
    shown = Option("--print-config", help="Print the settings in effect as TOML, and stop.")
    yield _parameter("config", Annotated[Path | None, config], None)
    yield _parameter("print_config", Annotated[bool, shown], False)
    for name, field in Settings.model_fields.items():
        if name not in SECRETS:
            default = "" if field.default in ("", (), None) else f" ({field.default})"
            option = Option(help=f"{field.description}{default}", show_default=False)
            flag_type = _flag_type(field.annotation)
            yield _parameter(name, Annotated[flag_type | None, option], None)


def _parameter(name: str, annotation: Any, default: object) -> inspect.Parameter:
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def _flag_type(annotation: Any) -> Any:
    """What typer reads: a list for a tuple, the text itself for one of several words."""
    parts = [part for part in get_args(annotation) if part not in (type(None), ...)]
    if get_origin(annotation) is tuple:
        return {Path: list[Path], int: list[int]}[parts[0]]
    if parts and isinstance(parts[0], str):
        return str
    return parts[0] if parts else annotation


serve.__signature__ = inspect.Signature(list(_parameters()))  # type: ignore[attr-defined]
serve.__annotations__ = {"return": None}
