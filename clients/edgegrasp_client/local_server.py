"""A server of one's own, for demos, benchmarks and tests: started, used, stopped."""

import subprocess
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from edgegrasp_client.errors import ServerUnavailableError

STOP_SECONDS = 15.0


class Addresses(NamedTuple):
    """Where a local server listens."""

    http_url: str  # such as http://127.0.0.1:8000
    grpc_address: str  # such as 127.0.0.1:50051
    pid: int = 0  # of the front


@contextmanager
def local_server(*flags: str, program: Sequence[str] = ()) -> Iterator[Addresses]:
    """Run `edgegrasp serve` on free ports while the context lasts.

    Args:
        flags: Further flags of `edgegrasp serve`.
        program: What to run as `edgegrasp`; empty: the one that is installed here.

    Yields:
        Its addresses, once it is ready.

    Raises:
        ServerUnavailableError: It is not installed here or does not start; it says why on stderr.
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
