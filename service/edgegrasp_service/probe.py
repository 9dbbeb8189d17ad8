"""Is the server of these settings ready? For the health check of a container.

usage: python -m edgegrasp_service.probe    exits with 0 where it is
"""

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
        connection = _connection(settings, host)
        try:
            connection.request("GET", "/health/ready")
            return connection.getresponse().status == 200
        finally:
            connection.close()
    except (OSError, http.client.HTTPException):
        return False


def _connection(settings: Settings, host: str) -> http.client.HTTPConnection:
    if settings.tls_certificate is None:
        return http.client.HTTPConnection(host, settings.http_port, timeout=TIMEOUT)
    # The certificate is for the name others call the server by; this asks itself.
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return http.client.HTTPSConnection(host, settings.http_port, timeout=TIMEOUT, context=context)


if __name__ == "__main__":
    sys.exit(not is_ready(load_settings()))
