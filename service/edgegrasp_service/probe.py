"""Is the server of these settings ready? For the health check of a container.

usage: python -m edgegrasp_service.probe    exits with 0 where it is
"""

import socket
import ssl
import sys
import urllib.request

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
        # The certificate is for the name others call the server by; this asks itself.
        context = ssl._create_unverified_context() if settings.tls_certificate else None
        place = f"[{host}]" if ":" in host else host
        url = f"http{'s' * bool(context)}://{place}:{settings.http_port}/health/ready"
        opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context)
        )
        with opener.open(url, timeout=TIMEOUT):
            return True
    except OSError:  # an HTTPError too
        return False


if __name__ == "__main__":
    sys.exit(not is_ready(load_settings()))
