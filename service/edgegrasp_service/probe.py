"""Is the server of these settings ready? For the health check of a container.

usage: python -m edgegrasp_service.probe    exits with 0 where it is
"""

import contextlib
import http.client
import socket
import ssl
import sys

from edgegrasp_service.settings import Settings, load_settings

TIMEOUT = 2.0  # seconds


def is_ready(settings: Settings) -> bool:
    """Whether a server on this machine answers requests.

    One that wants a client's certificate is asked for nothing more than to listen: it does once it
    has started, ready or not.
    """
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(settings.host, settings.host)
    try:
        if settings.tls_client_ca is not None:
            socket.create_connection((host, settings.http_port), TIMEOUT).close()
            return True
        connection = http.client.HTTPConnection(host, settings.http_port, timeout=TIMEOUT)
        if settings.tls_certificate is not None:
            # The certificate is for the name others call the server by; this asks itself.
            context = ssl._create_unverified_context()
            connection = http.client.HTTPSConnection(
                host, settings.http_port, timeout=TIMEOUT, context=context
            )
        with contextlib.closing(connection):
            connection.request("GET", "/health/ready")
            return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False


if __name__ == "__main__":
    sys.exit(not is_ready(load_settings()))
