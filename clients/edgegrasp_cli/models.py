"""`edgegrasp models`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edgegrasp_cli.connection import (
    TlsCa,
    TlsCertificate,
    TlsKey,
    TokenFile,
    UseTls,
    connect,
)

if TYPE_CHECKING:
    from edgegrasp_client import Model


def models(
    server: Annotated[
        str | None, typer.Option(help="host:port (gRPC) or http://host:port; else in this process.")
    ] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for a server.")] = 60.0,
    token_file: TokenFile = None,
    tls: UseTls = False,
    tls_ca: TlsCa = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    weights: Annotated[
        list[Path] | None, typer.Option(help="Weights file or folder, besides those that ship.")
    ] = None,
) -> None:
    """List the weights that can be used, here or on a server."""
    from rich.console import Console
    from rich.table import Table

    connection = (timeout, token_file, tls, tls_ca, tls_certificate, tls_key)
    table = Table(
        "model", "architecture", "parameters", "crop radius (m)", "gripper", "device", "digest"
    )
    for row in _of_server(server, connection) if server else _of_this_process(weights or []):
        table.add_row(
            f"{row.name} (default)" if row.default else row.name,
            row.architecture,
            f"{row.parameters:,}",
            f"{row.crop_radius:g}",
            row.gripper,
            row.device,
            row.digest[:12],
        )
    Console().print(table)


def _of_server(address: str, connection: tuple[Any, ...]) -> "list[Model]":
    from edgegrasp_client import GraspClientError

    try:
        with connect(address, *connection) as client:
            return client.models()
    except GraspClientError as error:
        sys.exit(f"edgegrasp models: {error}")


def _of_this_process(weights: list[Path]) -> "list[Model]":
    from edgegrasp_client import Model
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.errors import EdgeGraspError

    try:
        facts = ModelCatalogue.load(weights).describe()
    except EdgeGraspError as error:
        sys.exit(f"edgegrasp models: {error}")
    return [Model(**{name: row[name] for name in Model.__dataclass_fields__}) for row in facts]
