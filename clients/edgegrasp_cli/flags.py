"""Flags of commands from pydantic models, and those for connecting to a server."""

import functools
import inspect
import json
import os
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from edgegrasp_client import GraspClient

Flags: TypeAlias = list[inspect.Parameter]
KEYWORD = inspect.Parameter.KEYWORD_ONLY
PLAIN_TYPES = (bool, int, float, str, Path)  # types that a flag takes directly
TOKEN_VARIABLE = "EDGEGRASP_CLIENT_TOKEN"


class ConnectionFlags(BaseModel, use_attribute_docstrings=True):
    """The flags for the connection to a server."""

    timeout: float = 60.0
    """Seconds to wait for a server"""
    token_file: Path | None = None
    """File with the server's token; default: EDGEGRASP_CLIENT_TOKEN"""
    tls: bool = False
    """TLS over gRPC, trusting this machine's certificate authorities"""
    tls_ca: Path | None = None
    """TLS, trusting the certificate authorities in a PEM file"""
    tls_certificate: Path | None = None
    """Client certificate, PEM"""
    tls_key: Path | None = None
    """Key of the client certificate, PEM"""

    def connect(self, address: str) -> "GraspClient":
        """A client of a server; raises GraspClientError."""
        from edgegrasp_client import GraspClient, Tls

        files = self.tls_ca, self.tls_certificate, self.tls_key
        tls = Tls(*files) if self.tls or any(files) else None
        token = os.environ.get(TOKEN_VARIABLE) or None
        try:
            if self.token_file is not None:
                token = self.token_file.read_text().strip()
                if len(token.split()) != 1:
                    raise ValueError("give a file with one token and nothing else")
        except (OSError, ValueError) as error:
            raise ValueError(f"token file {self.token_file}: {error}") from error
        return GraspClient(address, timeout=self.timeout, token=token, tls=tls)


class ServerFlags(ConnectionFlags):
    """The flags of a command that needs a server."""

    server: str = "127.0.0.1:50051"
    """The grasp server: host:port (gRPC) or http://host:port"""


def takes_flags(**groups: Flags) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add groups of flags to a command.

    The command has a keyword argument for each group: a dict of the flags that were given. An
    argument that is a pydantic model is a group too, with a flag for each field.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        parameters = inspect.signature(command).parameters.values()
        annotations = {each.name: each.annotation for each in parameters}
        models = {name: kind for name, kind in annotations.items() if hasattr(kind, "model_fields")}
        added = {name: model_flags(model) for name, model in models.items()} | groups

        @functools.wraps(command)
        def run(**given: Any) -> None:
            for group, flags in added.items():
                values = {flag.name: given.pop(flag.name) for flag in flags}
                asked = {name: value for name, value in values.items() if value not in (None, [])}
                given[group] = _checked(models[group], asked) if group in models else asked
            command(**given)

        own = [each.replace(kind=KEYWORD) for each in parameters if each.name not in added]
        run.__signature__ = inspect.Signature([*own, *chain(*added.values())])  # type: ignore[attr-defined]
        run.__annotations__ = {"return": None}  # typer reads only the signature
        return run

    return decorate


def model_flags(
    # Fields other than numbers, text, booleans and paths are given as JSON.
    model: type[BaseModel],
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
        meaning = " ".join((field.description or "").split())
        option = typer.Option(
            help=f"{meaning}{_default_text(field.default) if defaults else ''}",
            show_default=False,
            metavar=choices,
            rich_help_panel=panel,
        )
        annotation: Any = Annotated[flag_type | None, option]
        flags.append(inspect.Parameter(name, KEYWORD, default=None, annotation=annotation))
    return flags


def _checked(model: type[BaseModel], given: Mapping[str, Any]) -> BaseModel:
    """The model of these fields; a ValueError names flag, value and limit."""
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
    """The options from the flags of `option_flags`; raises InvalidRequest for a wrong value."""
    from edgegrasp_model.options import parse_options
    from edgegrasp_model.request_cloud import options_of_texts

    options = options_of_texts(
        (name, value if isinstance(value, str) else json.dumps(value))
        for name, value in given.items()
    )
    parse_options(options)  # a wrong value is refused before anything starts
    return options


def _flag_type(annotation: Any) -> tuple[Any, str | None]:
    """The type of a field for typer, and the placeholder in its help if it differs."""
    parts = [part for part in get_args(annotation) if part is not type(None)]
    choice = next((one for one in (annotation, *parts) if get_origin(one) is Literal), None)
    if choice is not None:
        other = ["JSON"] if choice in parts and len(parts) > 1 else []
        return str, "|".join([*get_args(choice), *other])
    if get_origin(annotation) is tuple and parts[-1] is ... and parts[0] in PLAIN_TYPES:
        return list[parts[0]], None  # type: ignore[valid-type]
    only = parts[0] if len(parts) == 1 else annotation
    return (only, None) if only in PLAIN_TYPES else (str, "JSON")


def _default_text(default: Any) -> str:
    """A default value for the help; empty for None and for objects."""
    if default in ("", (), None) or hasattr(default, "model_dump"):
        return ""
    return f" ({default if isinstance(default, (str, Path)) else json.dumps(default)})"
