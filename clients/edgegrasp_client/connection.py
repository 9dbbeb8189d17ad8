"""Addresses, TLS, tokens, retries and errors of a client; and a local server."""

import math
import random
import re
import ssl
import subprocess
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from edgegrasp_client.errors import InvalidRequestError, OverloadedError, ServerUnavailableError

HTTP_OVER_UNIX = "http+unix:"

# Retries of a call while the server is unavailable, enough for a restart; fewer before its first
# answer, since there is probably no server.
RETRIES, FEW_RETRIES = 8, 4
FIRST_DELAY, LONGEST_DELAY = 0.1, 2.0  # seconds; each delay is twice the previous one
STOP_SECONDS = 15.0  # for a local server to drain
LONGEST_TIMEOUT = 1e6  # seconds; gRPC cannot count much longer ones


@dataclass(frozen=True)
class Tls:
    """How to verify the server, and the client's own certificate; files in PEM."""

    ca: str | Path | None = None  # authorities to trust; None: those of the machine
    certificate: str | Path | None = None  # the client's own, for servers that require one
    key: str | Path | None = None  # of that certificate

    def __post_init__(self) -> None:
        """Raise InvalidRequestError for a certificate without its key."""
        if (self.certificate is None) != (self.key is None):
            raise invalid("tls", "a certificate or a key alone", "Give both or neither.")


def is_rest(address: str) -> bool:
    """Whether an address names the REST transport."""
    return address.startswith(("http://", "https://", HTTP_OVER_UNIX))


def is_local(address: str) -> bool:
    """Whether an address is on this machine, which is called without a proxy."""
    local = r"(https?://)?(localhost|127[.\d]*|\[::1\])(:|/|$)|unix:"
    return re.match(local, address) is not None


def checked_timeout(timeout: float) -> float:
    """A timeout, at most LONGEST_TIMEOUT; raises InvalidRequestError unless it is above 0."""
    try:
        seconds = float(timeout)
    except (TypeError, ValueError):
        seconds = math.nan
    if not seconds > 0.0:
        raise invalid("timeout", repr(timeout), "Give seconds, more than 0.")
    return min(seconds, LONGEST_TIMEOUT)


def retry_delay(error: ServerUnavailableError, attempt: int, answered: bool) -> float | None:
    """Seconds to wait after a failed attempt, counted from 0; None after the last one.

    Delays double and are randomised, so that clients refused together do not return together.
    """
    longest = min(FIRST_DELAY * 2 ** min(attempt, 10), LONGEST_DELAY)
    jittered = random.uniform(longest / 2, longest)
    if isinstance(error, OverloadedError):
        return error.retry_after + jittered
    return jittered if attempt < (RETRIES if answered else FEW_RETRIES) else None


def token_metadata(token: str | None) -> tuple[tuple[str, str], ...]:
    """The metadata or headers with a token; raises InvalidRequestError for an unusable one."""
    if token is None:
        return ()
    if not (token.isascii() and token.isprintable() and token and " " not in token):
        raise invalid("token", f"{len(token)} letters", "Give printable ASCII without spaces.")
    return (("authorization", f"Bearer {token}"),)


class Addresses(NamedTuple):
    """Where a local server listens."""

    http_url: str  # such as http://127.0.0.1:8000
    grpc_address: str  # such as 127.0.0.1:50051
    pid: int = 0  # of the front


@contextmanager
def local_server(*flags: str, program: Sequence[str] = ()) -> Iterator[Addresses]:
    """Run `edgegrasp serve` with further flags on free ports while the context lasts.

    `program`, if given, replaces `edgegrasp`. Yields the addresses once the server is ready.

    Raises:
        ServerUnavailableError: It is not installed or does not start; its stderr says why.
    """
    installed = Path(sysconfig.get_path("scripts")) / "edgegrasp"
    if not (program or installed.is_file()):
        raise ServerUnavailableError(f"{installed} is missing: pip install 'edgegrasp[service]'")
    ports = ("--http-port", "0", "--grpc-port", "0")
    command = [*(program or [str(installed)]), "serve", *ports, "--log-level", "warning", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            # "EdgeGrasp serves HTTP <url> gRPC <address>", printed when it is ready.
            words = server.stdout.readline().split()
            if len(words) != 6:
                raise ServerUnavailableError("the local server did not start; it says why above")
            yield Addresses(words[3], words[5], server.pid)
        finally:
            server.terminate()
            try:
                server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()


def unreachable(address: str, why: str) -> ServerUnavailableError:
    """The exception for a call whose connection was not made or broke."""
    hint = "Check the address, whether it needs TLS, a client certificate or a proxy (the "
    hint += "variables http_proxy and no_proxy), and that `edgegrasp serve` runs there."
    return ServerUnavailableError(f"No connection to {address} ({why}). {hint}")


def ssl_context(tls: Tls) -> ssl.SSLContext:
    """A context that trusts its files; raises InvalidRequestError for files that cannot be used."""
    try:
        context = ssl.create_default_context(cafile=tls.ca)
        if tls.certificate is not None:
            context.load_cert_chain(tls.certificate, tls.key)
    except OSError as error:  # also if a file contains no certificate
        raise invalid("tls", f"{tls} ({error})", "Give PEM files.") from None
    return context


def invalid(field: str, value: str, fix: str) -> InvalidRequestError:
    """The exception for a request that the client refuses before sending it."""
    return InvalidRequestError(f"{field}: got {value}. {fix}", field, value, fix)
