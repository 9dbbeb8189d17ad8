"""Who may ask, and over what: bearer tokens, and TLS of both transports from the same files."""

import hashlib
import hmac
import re
import ssl
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from edgegrasp_service.errors import InvalidSettings, PermissionDenied, Unauthenticated
from edgegrasp_service.settings import Settings

HEADER = "authorization"

FIX = "Send `authorization: Bearer TOKEN` with a token of this server."
ADMIN_FIX = "Send an admin token; where the server has none, send its process SIGHUP instead."

# RFC 6750's letters; fewer than 16 of them can be guessed.
_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]{16,512}=*")
_NAMED = re.compile(r"(?:([\w.-]{1,64}):)?(.*)", re.DOTALL)  # a line of a token file


@dataclass(frozen=True)
class Token:
    """A token that the server knows.

    Attributes:
        name: Shown in logs; "NAME:" before a token in its file, or else where it was read.
        digest: SHA-256; the token itself is not kept.
        is_admin: Whether it is good for reloading weights too.
    """

    name: str
    digest: bytes
    is_admin: bool = False


class Tokens:
    """Whether a request may do what it asks for.

    Args:
        known: Without one that is no admin's, nobody needs a token; without an admin's, nobody may
            reload weights.
    """

    def __init__(self, known: Iterable[Token] = ()) -> None:
        self._known = tuple(known)

    @property
    def required(self) -> bool:
        """Whether requests need a token."""
        return any(not token.is_admin for token in self._known)

    def check(self, authorization: str | None, *, admin: bool = False) -> Token | None:
        """The token of a request that may go on; None: it needs none.

        Args:
            authorization: Its header of that name.
            admin: Whether it asks for what only an admin token is good for.

        Raises:
            Unauthenticated: It has no token, or none that the server knows.
            PermissionDenied: It has a token that is good for less.
        """
        if not admin and not self.required:
            return None
        if admin and not any(token.is_admin for token in self._known):
            raise PermissionDenied(HEADER, "a call that this server takes from nobody", ADMIN_FIX)
        if authorization is None:
            raise Unauthenticated(HEADER, "nothing", FIX)
        scheme, _, text = authorization.strip().partition(" ")
        if scheme.lower() != "bearer":
            raise Unauthenticated(HEADER, "another scheme than Bearer", FIX)
        found = self._find(_digest(text.strip()))
        if found is None:
            raise Unauthenticated(HEADER, "a token that this server does not know", FIX)
        if admin and not found.is_admin:
            raise PermissionDenied(HEADER, "a token that is good for detection only", ADMIN_FIX)
        return found

    def _find(self, digest: bytes) -> Token | None:
        """The token of a digest, in a time that does not depend on which."""
        found = None
        for token in self._known:
            if hmac.compare_digest(digest, token.digest) and (found is None or token.is_admin):
                found = token
        return found


def load_tokens(settings: Settings) -> Tokens:
    """The tokens of settings and of the files they name.

    Raises:
        InvalidSettings: A file cannot be read, or what it holds is no token.
    """
    known: list[Token] = []
    for prefix in ("", "admin_"):
        secrets = getattr(settings, f"{prefix}tokens")
        known += _tokens(f"{prefix}tokens", [secret.get_secret_value() for secret in secrets])
        known += _from_file(f"{prefix}token_file", getattr(settings, f"{prefix}token_file"))
    return Tokens(known)


def _from_file(setting: str, path: Path | None) -> list[Token]:
    if path is None:
        return []
    try:
        lines = [line.strip() for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidSettings(
            f"{setting}: got {str(path)!r}. It cannot be read: {error}."
        ) from None
    tokens = _tokens(setting, [line for line in lines if line and not line.startswith("#")])
    if not tokens:
        raise InvalidSettings(f"{setting}: got {str(path)!r}. It holds no token; write one a line.")
    return tokens


def _tokens(setting: str, lines: list[str]) -> list[Token]:
    tokens = []
    for number, line in enumerate(lines, 1):
        name, text = _NAMED.fullmatch(line).groups()  # type: ignore[union-attr]  # anything matches
        if not _TOKEN.fullmatch(text):
            raise InvalidSettings(
                f"{setting}: got {len(text)} letters as token {number}. Use at least 16 of "
                "A-Z a-z 0-9 - . _ ~ + /, such as `openssl rand -hex 32` prints."
            )
        is_admin = setting.startswith("admin")
        tokens.append(Token(name or f"{setting} {number}", _digest(text), is_admin))
    return tokens


def _digest(token: str) -> bytes:
    """All of one length, so that comparing them tells nothing of a token's own."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


@dataclass(frozen=True)
class Certificates:
    """Key, certificate, and the CAs of clients where those are set."""

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
