"""The container image: its libraries, and its start script on processors of other machines."""

import os
from pathlib import Path

import pytest
from tests.programs import run

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("machine", "flags", "loops"),
    [
        ("aarch64", "", "generic"),
        ("x86_64", "flags : fpu avx2", "x86-64-v3"),
        ("x86_64", "flags : fpu avx2 avx512vl", "x86-64-v4"),
        ("x86_64", "flags : fpu", "of its own"),
    ],
)
def test_the_server_starts_with_the_loops_of_its_processor(machine, flags, loops, tmp_path) -> None:
    programs = {
        "uname": f"echo {machine}",
        "grep": f"echo '{flags}'",
        "cp": "true",
        "edgegrasp": 'echo "${NUMBA_CPU_NAME-of its own}: $*"',
    }
    for name, line in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CPU_NAME"}
    here = {**environment, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    started = run("/bin/sh", ROOT / "docker" / "start.sh", "--workers", "2", env=here)
    assert started.stdout == f"{loops}: serve --workers 2\n"
