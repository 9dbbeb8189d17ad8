"""Programs that tests run."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
EDGEGRASP = (sys.executable, "-c", "from edgegrasp_cli.main import main; main()")


def run(*words: object, code: int = 0, **more: Any) -> subprocess.CompletedProcess[str]:
    """What a program says; its exit status has to be `code`."""
    command = [str(word) for word in words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **more)
    assert done.returncode == code, done.stdout[-5000:] + done.stderr
    return done


@contextmanager
def started(*words: object, **more: Any) -> Iterator[subprocess.Popen[str]]:
    """A program that runs until the block ends, its output in a pipe unless that is set."""
    command, more = [str(word) for word in words], {"stdout": subprocess.PIPE, **more}
    with subprocess.Popen(command, text=True, **more) as process:
        try:
            yield process
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(30)
            process.kill()  # one that does not heed it


def until(condition: Callable[[], Any]) -> Any:
    """What a condition gives when it holds."""
    end = time.monotonic() + 240.0  # seconds, of a busy machine
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def free_ports(count: int) -> list[int]:
    """Ports on which nothing listens."""
    with ExitStack() as stack:
        made = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in made]
