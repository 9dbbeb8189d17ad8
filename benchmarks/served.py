"""A server in a process of its own, and what it takes of the machine."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

STOP_SECONDS = 30.0
PROGRAM = "from edgegrasp_cli.main import main; main()"
LOG_NONE = ("--log-level", "error")  # every refusal is a line, and they come by the thousand


@dataclass(frozen=True)
class Served:
    """A running server."""

    http_url: str
    grpc_address: str
    process: subprocess.Popen[str]

    def address(self, transport: str) -> str:
        """Where a transport listens."""
        return self.grpc_address if transport == "grpc" else self.http_url

    def memory(self) -> float:
        """Resident memory now, MB."""
        return self._status("VmRSS")

    def peak_memory(self) -> float:
        """Most resident memory so far, MB."""
        return self._status("VmHWM")

    def cpu_seconds(self) -> float:
        """Processor time so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def threads(self) -> int:
        """Threads now."""
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))

    def files(self) -> int:
        """Open file descriptors now, sockets among them."""
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))

    def stop(self) -> int:
        """Send SIGTERM; gives back the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(STOP_SECONDS)

    def _status(self, name: str) -> float:
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) / 1024
        raise LookupError(name)


@contextmanager
def served(*flags: str, threads: int | None = None) -> Iterator[Served]:
    """Run `edgegrasp serve` on free ports of 127.0.0.1 while the context lasts.

    Args:
        flags: Further flags of `edgegrasp serve`.
        threads: Threads of one operator of the network; None: as many as there are cores.
    """
    command = [sys.executable, "-c", PROGRAM, "serve", "--http-port", "0", "--grpc-port", "0"]
    environment = dict(os.environ)
    if threads is not None:
        environment |= {"OMP_NUM_THREADS": str(threads)}
    process = subprocess.Popen(
        [*command, *LOG_NONE, *flags], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    try:
        # "EdgeGrasp serves HTTP <url> gRPC <address>", printed when it is ready.
        words = process.stdout.readline().split()
        if len(words) != 6:
            raise RuntimeError("the server did not start; it says why above")
        yield Served(words[3], words[5], process)
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
        process.stdout.close()
