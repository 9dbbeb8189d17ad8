"""Flags shared by commands: those of pydantic models, and those for connecting to a server."""

import functools
import inspect
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar, get_args, get_origin

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel

    from edgegrasp_client import GraspClient

Model = TypeVar("Model", bound="BaseModel")
Flags: TypeAlias = list[inspect.Parameter]
PLAIN = (bool, int, float, str, Path)  # types that a flag takes directly
TOKEN_VARIABLE = "EDGEGRASP_CLIENT_TOKEN"

Timeout = Annotated[float, typer.Option(help="Seconds to wait for a server.")]


def takes_flags(**groups: Flags) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add groups of flags to a command.

    The command has a keyword argument for each group: a dict of the flags that were given.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**given: Any) -> None:
            for group, flags in groups.items():
                values = {flag.name: given.pop(flag.name) for flag in flags}
                given[group] = {n: value for n, value in values.items() if value not in (None, [])}
            command(**given)

        own = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for parameter in inspect.signature(command).parameters.values()
            if parameter.name not in groups
        ]
        added = [flag for flags in groups.values() for flag in flags]
        run.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
        run.__annotations__ = {"return": None}  # typer reads only the signature
        return run

    return decorate


def model_flags(
    # The fields; those other than numbers, text, booleans and paths are given as JSON.
    model: "type[BaseModel]",
    leave_out: Sequence[str] = (),  # fields without a flag
    panel: str = "Options",  # heading of the flags in the help
    defaults: bool = True,  # whether the help shows the fields' defaults
) -> Flags:
    """A flag for each field of a pydantic model, with the field's description and default."""
    flags = []
    for name, field in model.model_fields.items():
        if name in leave_out:
            continue
        flag_type, choices = _flag_type(field.annotation)
        option = typer.Option(
            help=f"{field.description}{_default_text(field.default) if defaults else ''}",
            show_default=False,
            metavar=choices,
            rich_help_panel=panel,
        )
        annotation: Any = Annotated[flag_type | None, option]
        keyword = inspect.Parameter.KEYWORD_ONLY
        flags.append(inspect.Parameter(name, keyword, default=None, annotation=annotation))
    return flags


def given_flags(model: "type[Model]", given: Mapping[str, Any]) -> "Model":
    """The model from the flags of `model_flags`; a ValueError names flag, value and limit."""
    from pydantic import ValidationError

    try:
        return model(**given)
    except ValidationError as error:
        first = error.errors()[0]
        flag = "-".join(str(first["loc"][0]).split("_"))
        raise ValueError(f"--{flag}: got {first['input']!r}. {first['msg']}.") from None


def option_flags(*leave_out: str, defaults: bool = True) -> Flags:
    """A flag for each option of a detection; `defaults`: whether the help shows the detector's."""
    from edgegrasp_model.options import DetectOptions

    return model_flags(DetectOptions, leave_out, "Options of the detection", defaults)


def parse_option_flags(given: Mapping[str, Any]) -> dict[str, Any]:
    """The options from the flags of `option_flags`; InvalidRequest: a value is wrong."""
    from edgegrasp_model.options import parse_options
    from edgegrasp_service.worker.http_bodies import options_from_query

    options = options_from_query(
        (name, value if isinstance(value, str) else json.dumps(value))
        for name, value in given.items()
    )
    parse_options(options)  # a wrong value is refused before anything starts
    return options


def connect(
    address: str,
    timeout: float,
    retry: bool = True,
    *,
    token_file: Annotated[
        Path | None, typer.Option(help=f"File with the server's token; else {TOKEN_VARIABLE}.")
    ] = None,
    tls: Annotated[
        bool, typer.Option("--tls", help="TLS over gRPC, trusting this machine's authorities.")
    ] = False,
    tls_ca: Annotated[
        Path | None, typer.Option(help="TLS, trusting the authorities in a PEM file.")
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option(help="Client certificate, PEM.")] = None,
    tls_key: Annotated[
        Path | None, typer.Option(help="Key of the client certificate, PEM.")
    ] = None,
) -> "GraspClient":
    """A client of a server, by the flags in `CONNECTION`; raises GraspClientError."""
    from edgegrasp_client import GraspClient, Tls

    files = (tls_ca, tls_certificate, tls_key)
    return GraspClient(
        address,
        timeout=timeout,
        retry=retry,
        token=_token(token_file),
        tls=Tls(*files) if tls or any(files) else None,
    )


CONNECTION: Flags = [
    parameter
    for parameter in inspect.signature(connect).parameters.values()
    if parameter.kind is inspect.Parameter.KEYWORD_ONLY
]


def _token(file: Path | None) -> str | None:
    if file is None:
        return os.environ.get(TOKEN_VARIABLE) or None
    try:
        return file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"token file {file}: {error}") from error


def _flag_type(annotation: Any) -> tuple[Any, str | None]:
    """The type of a field for typer, and the placeholder in its help if it differs."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    choice = next((one for one in (annotation, *parts) if get_origin(one) is Literal), None)
    if choice is not None:
        return str, "|".join(get_args(choice))
    if get_origin(annotation) is tuple and parts[-1] is ... and parts[0] in PLAIN:
        return list[parts[0]], None  # type: ignore[valid-type]
    only = parts[0] if len(parts) == 1 else annotation
    return (only, None) if only in PLAIN else (str, "JSON")


def _default_text(default: Any) -> str:
    """A default value for the help; empty for None and for objects."""
    if default in ("", (), None) or hasattr(default, "model_dump"):
        return ""
    return f" ({default if isinstance(default, (str, Path)) else json.dumps(default)})"
