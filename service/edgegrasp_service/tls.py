"""TLS of both transports, from the same files, which may be read anew while connections come in."""

import ssl
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.settings import Settings


@dataclass(frozen=True)
class Certificates:
    """What is in the files: key, certificate, and the CAs of clients where those are set."""

    http: ssl.SSLContext
    grpc: grpc.ServerCertificateConfiguration


class ServerTls:
    """What each transport needs to speak TLS, with client certificates where a CA is set.

    Attributes:
        http: For the HTTP server.
        grpc: For the gRPC server.
    """

    def __init__(self, read: Callable[[], Certificates], require_clients: bool) -> None:
        """Read the files.

        Args:
            read: Reads them; raises InvalidSettings.
            require_clients: Whether a client must show a certificate.
        """
        self.read = read
        first = read()
        self.http = _RenewableContext(ssl.PROTOCOL_TLS_SERVER)
        self.http.current = first.http
        self._lock = threading.Lock()
        self._next: grpc.ServerCertificateConfiguration | None = None
        self.grpc = grpc.dynamic_ssl_server_credentials(
            first.grpc,
            self._take_next,  # type: ignore[arg-type]  # None is left out of its stubs
            require_client_authentication=require_clients,
        )

    def use(self, certificates: Certificates) -> None:
        """Use others from the next connection on; those that are open stay as they are."""
        self.http.current = certificates.http
        with self._lock:
            self._next = certificates.grpc

    def _take_next(self) -> grpc.ServerCertificateConfiguration | None:
        """Asked by gRPC for each connection, in a thread of its own; None: as before."""
        with self._lock:
            taken, self._next = self._next, None
        return taken


class _RenewableContext(ssl.SSLContext):
    """A context that leaves each new connection to the one that is current then."""

    current: ssl.SSLContext

    def wrap_bio(self, *arguments: Any, **named: Any) -> ssl.SSLObject:
        """As asyncio calls it when a connection comes in."""
        return self.current.wrap_bio(*arguments, **named)


def load_tls(settings: Settings) -> ServerTls | None:
    """Read certificate, key and client CA; None where the settings name no certificate.

    Raises:
        InvalidSettings: A file cannot be read, or certificate and key are no pair.
    """
    certificate, key, ca = settings.tls_certificate, settings.tls_key, settings.tls_client_ca
    if certificate is None or key is None:
        return None
    return ServerTls(lambda: _read_certificates(certificate, key, ca), ca is not None)


def _read_certificates(certificate: Path, key: Path, ca: Path | None) -> Certificates:
    pair = (_read("tls_key", key), _read("tls_certificate", certificate))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_alpn_protocols(["http/1.1"])
    try:
        context.load_cert_chain(certificate, key, password=_refuse_encrypted_key)
    except (ssl.SSLError, ValueError) as error:
        raise InvalidSettings(
            f"tls_certificate: got {str(certificate)!r} with tls_key {str(key)!r}. "
            f"They are no certificate with its key, in PEM: {error}."
        ) from None
    authorities = None
    if ca is not None:
        authorities = _read("tls_client_ca", ca)
        _require_clients(context, ca)
    return Certificates(context, grpc.ssl_server_certificate_configuration([pair], authorities))


def _require_clients(context: ssl.SSLContext, ca: Path) -> None:
    try:
        context.load_verify_locations(ca)
    except ssl.SSLError as error:
        raise InvalidSettings(
            f"tls_client_ca: got {str(ca)!r}. It holds no certificate in PEM: {error}."
        ) from None
    context.verify_mode = ssl.CERT_REQUIRED


def _read(name: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidSettings(f"{name}: got {str(path)!r}. {error.strerror}.") from None


def _refuse_encrypted_key() -> str:
    """Called for an encrypted key, in the place of a question on the terminal."""
    raise ValueError("the key is encrypted, and nobody is there to ask")
