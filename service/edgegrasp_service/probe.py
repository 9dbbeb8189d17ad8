"""Health check for containers: is the server of these settings ready?

`python -m edgegrasp_service.probe` exits with 0 if it is.
"""

import contextlib
import os
import socket
import sys
import tomllib
from pathlib import Path
from typing import Any

TIMEOUT_SECONDS = 2.0
NAMES = ("host", "http_port", "tls_certificate", "tls_client_ca")
REQUEST = b"GET /health/ready HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"


def read_settings() -> dict[str, Any]:
    """The settings in NAMES, from the server's file and environment.

    Does not use `edgegrasp_service.settings`: importing Pydantic takes far longer than the check.
    """
    path = os.environ.get("EDGEGRASP_CONFIG")
    given: dict[str, Any] = tomllib.loads(Path(path).read_text("utf-8")) if path else {}
    given |= {name: text for name in NAMES if (text := os.environ.get(f"EDGEGRASP_{name.upper()}"))}
    return {name: given[name] for name in NAMES if name in given}


def is_ready(
    host: str = "127.0.0.1",
    http_port: int | str = 8000,
    tls_certificate: object = None,
    tls_client_ca: object = None,
) -> bool:
    """Whether a server on this machine answers requests.

    A server that requires client certificates is only checked for listening, which it does once
    started, ready or not.
    """
    try:
        with contextlib.ExitStack() as stack:
            connection = stack.enter_context(_connect(host, int(http_port)))
            if tls_client_ca is not None:
                return True
            if tls_certificate is not None:
                import ssl

                # The certificate is for the server's public name, but this connects to localhost.
                context = ssl._create_unverified_context()
                connection = stack.enter_context(context.wrap_socket(connection))
            connection.sendall(REQUEST)
            answer = stack.enter_context(connection.makefile("rb"))
            return answer.readline().startswith(b"HTTP/1.1 200 ")
    except OSError:
        return False


def _connect(host: str, port: int) -> socket.socket:
    if not host.startswith("unix:"):
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        return socket.create_connection((host, port), TIMEOUT_SECONDS)
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(TIMEOUT_SECONDS)
    connection.connect(f"{host.removeprefix('unix:')}/http.sock")
    return connection


if __name__ == "__main__":
    sys.exit(not is_ready(**read_settings()))
