"""Flags of the commands that ask a server: how to know it, and what to show it."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

if TYPE_CHECKING:
    from edgegrasp_client import GraspClient

TOKEN_VARIABLE = "EDGEGRASP_CLIENT_TOKEN"

TokenFile = Annotated[
    Path | None, typer.Option(help=f"File with the server's token; else {TOKEN_VARIABLE}.")
]
UseTls = Annotated[
    bool, typer.Option("--tls", help="TLS over gRPC, trusting this machine's authorities.")
]
TlsCa = Annotated[Path | None, typer.Option(help="TLS, trusting the authorities in a PEM file.")]
TlsCertificate = Annotated[Path | None, typer.Option(help="One's own certificate, PEM.")]
TlsKey = Annotated[Path | None, typer.Option(help="The key of one's own certificate, PEM.")]

# The values of these flags, in this order: token file, TLS or not, authorities, certificate, key.
Connection: TypeAlias = tuple[Path | None, bool, Path | None, Path | None, Path | None]
NO_CONNECTION: Connection = (None, False, None, None, None)
FLAGS = ("token_file", "tls", "tls_ca", "tls_certificate", "tls_key")


def connect(
    address: str,
    timeout: float,
    token_file: Path | None,
    tls: bool,
    tls_ca: Path | None,
    tls_certificate: Path | None,
    tls_key: Path | None,
) -> "GraspClient":
    """A client of a server.

    Raises:
        GraspClientError: A token or a file cannot be used.
    """
    from edgegrasp_client import GraspClient, Tls

    files = (tls_ca, tls_certificate, tls_key)
    secure = tls or any(files)
    return GraspClient(
        address,
        timeout=timeout,
        token=_token(token_file),
        tls=Tls(*files) if secure else None,
    )


def _token(file: Path | None) -> str | None:
    if file is None:
        return os.environ.get(TOKEN_VARIABLE) or None
    try:
        return file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        sys.exit(f"edgegrasp: token file {file}: {error}")
