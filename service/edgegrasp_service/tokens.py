"""Bearer tokens: which there are, and whether a request may do what it asks for."""

import hashlib
import hmac
import re
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path

from edgegrasp_service.errors import InvalidSettings, PermissionDenied, Unauthenticated
from edgegrasp_service.settings import Settings

HEADER = "authorization"

# Whether the running request showed an admin token: what needs one asks here, so that no other
# spelling of an address comes around the check at the edge.
IS_ADMIN: ContextVar[bool] = ContextVar("is_admin", default=False)
FIX = "Send `authorization: Bearer TOKEN` with a token of this server."
ADMIN_FIX = "Send an admin token; where the server has none, send its process SIGHUP instead."

# RFC 6750's letters; fewer than 16 of them can be guessed.
_TOKEN = re.compile(r"[A-Za-z0-9._~+/-]{16,512}=*")


class Tokens:
    """The tokens a server knows; only digests of them are kept.

    Args:
        users: Tokens for detection, scoring, listing and metrics; none at all: no need of one.
        admins: Tokens for reloading weights, and for the rest too; none: nobody may.
    """

    def __init__(self, users: Iterable[str] = (), admins: Iterable[str] = ()) -> None:
        self._admins = [_digest(token) for token in admins]
        self._users = [_digest(token) for token in users]

    @property
    def required(self) -> bool:
        """Whether requests need a token."""
        return bool(self._users)

    def check(self, authorization: str | None, *, admin: bool = False) -> None:
        """Pass where a request may go on.

        Args:
            authorization: Its header of that name.
            admin: Whether it asks for what only an admin token is good for.

        Raises:
            Unauthenticated: It has no token, or none that the server knows.
            PermissionDenied: It has a token that is good for less.
        """
        if not admin and not self.required:
            return
        if admin and not self._admins:
            raise PermissionDenied(HEADER, "a call that this server takes from nobody", ADMIN_FIX)
        if authorization is None:
            raise Unauthenticated(HEADER, "nothing", FIX)
        scheme, _, token = authorization.strip().partition(" ")
        if scheme.lower() != "bearer":
            raise Unauthenticated(HEADER, "another scheme than Bearer", FIX)
        digest = _digest(token.strip())
        is_admin, is_user = _among(digest, self._admins), _among(digest, self._users)
        if admin and is_user and not is_admin:
            raise PermissionDenied(HEADER, "a token that is good for detection only", ADMIN_FIX)
        if not is_admin and (admin or not is_user):
            raise Unauthenticated(HEADER, "a token that this server does not know", FIX)
        IS_ADMIN.set(is_admin)


def load_tokens(settings: Settings) -> Tokens:
    """The tokens of settings and of the files they name.

    Raises:
        InvalidSettings: A file cannot be read, or what it holds is no token.
    """
    users = [secret.get_secret_value() for secret in settings.tokens]
    admins = [secret.get_secret_value() for secret in settings.admin_tokens]
    return Tokens(
        _checked("tokens", users) + _from_file("token_file", settings.token_file),
        _checked("admin_tokens", admins)
        + _from_file("admin_token_file", settings.admin_token_file),
    )


def _from_file(name: str, path: Path | None) -> list[str]:
    if path is None:
        return []
    try:
        lines = [line.strip() for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidSettings(f"{name}: got {str(path)!r}. It cannot be read: {error}.") from None
    tokens = _checked(name, [line for line in lines if line and not line.startswith("#")])
    if not tokens:
        raise InvalidSettings(f"{name}: got {str(path)!r}. It holds no token; write one a line.")
    return tokens


def _checked(name: str, tokens: list[str]) -> list[str]:
    for number, token in enumerate(tokens, 1):
        if not _TOKEN.fullmatch(token):
            raise InvalidSettings(
                f"{name}: got {len(token)} letters as token {number}. Use at least 16 of "
                "A-Z a-z 0-9 - . _ ~ + /, such as `openssl rand -hex 32` prints."
            )
    return tokens


def _digest(token: str) -> bytes:
    """All of one length, so that comparing them tells nothing of a token's own."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _among(digest: bytes, known: Iterable[bytes]) -> bool:
    """Whether it is one of them, in a time that does not depend on which."""
    found = False
    for other in known:
        found |= hmac.compare_digest(digest, other)
    return found
