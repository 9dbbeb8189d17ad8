"""TLS of both transports, from the same files."""

import ssl
from dataclasses import dataclass
from pathlib import Path

import grpc

from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.settings import Settings


@dataclass(frozen=True)
class ServerTls:
    """What each transport needs to speak TLS, with client certificates where a CA is set."""

    http: ssl.SSLContext
    grpc: grpc.ServerCredentials


def load_tls(settings: Settings) -> ServerTls | None:
    """Read certificate, key and client CA; None where the settings name no certificate.

    Raises:
        InvalidSettings: A file cannot be read, or certificate and key are no pair.
    """
    if settings.tls_certificate is None or settings.tls_key is None:
        return None
    certificate = _read("tls_certificate", settings.tls_certificate)
    key = _read("tls_key", settings.tls_key)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_alpn_protocols(["http/1.1"])
    try:
        context.load_cert_chain(
            settings.tls_certificate, settings.tls_key, password=_refuse_encrypted_key
        )
    except (ssl.SSLError, ValueError) as error:
        raise InvalidSettings(
            f"tls_certificate: got {str(settings.tls_certificate)!r} with tls_key "
            f"{str(settings.tls_key)!r}. They are no certificate with its key, in PEM: {error}."
        ) from None
    ca = None
    if settings.tls_client_ca is not None:
        ca = _read("tls_client_ca", settings.tls_client_ca)
        _require_clients(context, settings.tls_client_ca)
    credentials = grpc.ssl_server_credentials(
        [(key, certificate)], root_certificates=ca, require_client_auth=ca is not None
    )
    return ServerTls(context, credentials)


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
