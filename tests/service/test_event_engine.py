"""gRPC reads in the thread that waits for requests; it has to be told before it is imported."""

import subprocess
import sys

import pytest

PROGRAM = """
import os, sys
from edgegrasp_cli.main import main
import edgegrasp_service
print("grpc" in sys.modules, os.environ["GRPC_EXPERIMENTS"])
import asyncio
from grpc import aio

async def start():
    server = aio.server()
    server.add_insecure_port("127.0.0.1:0")
    await server.start()
    await server.stop(None)

asyncio.run(start())
"""


@pytest.mark.parametrize("given", [None, "event_engine_listener"])
def test_grpc_is_told_in_time_and_knows_the_name(
    monkeypatch: pytest.MonkeyPatch, given: str | None
) -> None:
    monkeypatch.delenv("GRPC_EXPERIMENTS", raising=False)
    if given is not None:  # an operator's own
        monkeypatch.setenv("GRPC_EXPERIMENTS", given)
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"False {given or '-event_engine_listener'}\n"
