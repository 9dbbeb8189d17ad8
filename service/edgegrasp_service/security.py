"""Access control: bearer tokens, and TLS for both transports from the same files."""

import hashlib
import re
import ssl
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import grpc

from edgegrasp_service.errors import InvalidSettings, Unauthenticated
from edgegrasp_service.settings import Settings

TOKEN_HEADER = "authorization"

TOKEN_FIX = "Send `authorization: Bearer TOKEN` with a token of this server."
ADMIN_FIX = "Send an admin token; where the server has none, send its process SIGHUP instead."

# RFC 6750's characters; fewer than 16 can be guessed.
_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]{16,512}=*")


class Token(NamedTuple):
    """What is known of a token."""

    name: str  # for logs: "NAME:" before a token in its file, else where it was read
    is_admin: bool  # whether it also permits reloading weights


class Tokens:
    """The tokens in the files that the settings name; raises InvalidSettings for a bad file.

    Without ordinary tokens none is required; without admin tokens nobody may reload weights.
    """

    def __init__(self, settings: Settings) -> None:
        self.known = _read_tokens("token_file", settings.token_file)
        self.known |= _read_tokens("admin_token_file", settings.admin_token_file)
        self.required = settings.token_file is not None  # by requests

    def check(self, authorization: str | None) -> Token:
        """The token in the header `authorization`; raises Unauthenticated if it is not known."""
        scheme, _, text = (authorization or "").strip().partition(" ")
        found = self.known.get(_digest(text.strip()))
        if found is None or scheme.lower() != "bearer":
            value = "a token that this server does not know" if authorization else "nothing"
            raise Unauthenticated(TOKEN_HEADER, value, TOKEN_FIX)
        return found


def _read_tokens(setting: str, path: Path | None) -> dict[bytes, Token]:
    """Tokens by their digests: they are not kept, and timing reveals nothing about them."""
    if path is None:
        return {}
    try:
        lines = [line.partition("#")[0].strip() for line in path.read_text("utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        why = f"{setting}: got {str(path)!r}. It cannot be read: {error}."
        raise InvalidSettings(why) from None
    tokens: dict[bytes, Token] = {}
    for number, line in enumerate(filter(None, lines), start=1):
        name, _, text = line.rpartition(":")
        if not _TOKEN.fullmatch(text):
            raise InvalidSettings(
                f"{setting}: got {len(text)} letters as token {number}. Use at least 16 of "
                "A-Z a-z 0-9 - . _ ~ + /, such as `openssl rand -hex 32` prints."
            )
        tokens[_digest(text)] = Token(name or f"{setting} {number}", setting.startswith("admin"))
    if not tokens:
        raise InvalidSettings(f"{setting}: got {str(path)!r}. It has no token; write one per line.")
    return tokens


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


class ServerTls:
    """TLS of both transports; raises InvalidSettings for files that do not belong together."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.http = _RenewableContext(ssl.PROTOCOL_TLS_SERVER)
        self._for_grpc = deque[grpc.ServerCertificateConfiguration](maxlen=1)  # not used yet
        self.use(self.read())
        self.grpc = grpc.dynamic_ssl_server_credentials(
            self._for_grpc.pop(),
            self._renewed,
            require_client_authentication=settings.tls_client_ca is not None,
        )

    def use(self, certificates: "Certificates") -> None:
        """Use these certificates for new connections; open ones are not affected."""
        self.http.current, for_grpc = certificates
        self._for_grpc.append(for_grpc)

    def _renewed(self) -> Any:
        """Certificates to use from the next connection on, or None; gRPC asks at each one.

        Returned once, since gRPC crashes if it often gets new ones (grpc issue 36693).
        """
        with suppress(IndexError):
            return self._for_grpc.pop()
        return None

    def read(self) -> "Certificates":
        """Read the files; raises InvalidSettings."""
        settings = self._settings
        certificate, key, ca = settings.tls_certificate, settings.tls_key, settings.tls_client_ca
        assert certificate is not None
        assert key is not None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.set_alpn_protocols(["http/1.1"])
        try:
            pair, authorities = (key.read_bytes(), certificate.read_bytes()), None
            context.load_cert_chain(certificate, key, password=_refuse_encrypted_key)
            if ca is not None:
                authorities = ca.read_bytes()
                context.load_verify_locations(ca)
                context.verify_mode = ssl.CERT_REQUIRED
        except (OSError, ValueError) as error:  # an SSLError too
            files = f"tls_certificate {certificate}, tls_key {key}"
            files += f" and tls_client_ca {ca}" if ca else ""
            wrong = f"{files}: they cannot be read as a certificate with its key, in PEM: {error}."
            raise InvalidSettings(wrong) from None
        return context, grpc.ssl_server_certificate_configuration([pair], authorities)


Certificates = tuple[ssl.SSLContext, grpc.ServerCertificateConfiguration]


class _RenewableContext(ssl.SSLContext):
    """A context that delegates each new connection to the current context."""

    current: ssl.SSLContext

    def wrap_bio(self, *arguments: Any, **named: Any) -> ssl.SSLObject:
        """Called by asyncio for each new connection."""
        return self.current.wrap_bio(*arguments, **named)


def _refuse_encrypted_key() -> str:
    """Called for an encrypted key, instead of a prompt on the terminal."""
    raise ValueError("the key is encrypted; store it without a passphrase")
