"""A server of one's own, for demos, benchmarks and tests: started, used, stopped."""

import subprocess
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from edgegrasp_client.errors import ServerUnavailableError

STOP_SECONDS = 15.0


class Addresses(NamedTuple):
    """Where a local server listens."""

    http_url: str  # such as http://127.0.0.1:8000
    grpc_address: str  # such as 127.0.0.1:50051


@contextmanager
def local_server(*flags: str) -> Iterator[Addresses]:
    """Run `edgegrasp serve` on free ports while the context lasts.

    Args:
        flags: Further flags of `edgegrasp serve`.

    Yields:
        Its addresses, once it is ready.

    Raises:
        ServerUnavailableError: It is not installed here or does not start; it says why on stderr.
    """
    program = Path(sysconfig.get_path("scripts")) / "edgegrasp"
    if not program.is_file():
        raise ServerUnavailableError(f"{program} is missing: pip install 'edgegrasp[service]'")
    ports = ("--http-port", "0", "--grpc-port", "0")
    command = [str(program), "serve", *ports, "--log-level", "warning", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            # "EdgeGrasp serves HTTP <url> gRPC <address>", printed when it is ready.
            words = server.stdout.readline().split()
            if len(words) != 6:
                raise ServerUnavailableError("the local server did not start; it says why above")
            yield Addresses(words[3], words[5])
        finally:
            server.terminate()
            try:
                server.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                server.kill()
