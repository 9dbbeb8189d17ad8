"""The tree holds what it should, nothing of the machine it was made on, and scripts that work."""

import ast
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from tests.programs import ROOT, run

# Package indexes and absolute paths of somebody's machine; in pieces, or this file would match.
HOSTS = ["pypi" + r"\.org", "python" + "hosted", "npm" + r"js\.org", r"deb\." + "debian"]
FOREIGN = re.compile(
    "|".join([*HOSTS, "--index" + "-url", r"(?<![\w.}])/(?:work|root|home|mnt)/\w"])
)


def tracked_files() -> list[Path]:
    command = ("git", "ls-files", "-z")
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout, so there is no list of tracked files")
    return [path for name in listed.stdout.split("\0") if (path := ROOT / name).is_file()]


def test_tracked_files_are_small_and_name_no_registry_or_path_of_one_machine() -> None:
    assert [path.name for path in tracked_files() if path.stat().st_size > 20 * 2**20] == []
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in tracked_files()
        for match in FOREIGN.finditer(path.read_text("utf-8", errors="replace"))
    ]
    assert found == []


def test_functions_fit_on_a_screen() -> None:
    large = []
    for path in tracked_files():
        if path.suffix != ".py" or "_pb2" in path.name:
            continue
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                count = sum(one.arg not in ("self", "cls") for one in given)
                if lines > 60 or count > 10:
                    large.append(f"{path.name}: {node.name}, {lines} lines, {count} parameters")
    assert large == []


SCRIPT = ROOT / "scripts" / "system_packages.sh"
VENV_CHECK = "import ensurepip, venv"


def stand_in(folder: Path, name: str, body: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/bash\n{body}\n")
    path.chmod(0o755)


def machine(folder: Path, *, lacks: str, user: int = 0, apt: bool = True) -> dict[str, str]:
    """A folder of stand-ins as PATH; what is lacking is what a bash pattern matches."""
    fails = f'case "$*" in {lacks}) exit 1;; *print*) echo python3.11-venv;; esac'
    stand_in(folder, "python3", fails)
    stand_in(folder, "id", f"echo {user}")
    stand_in(folder, "uname", "echo Linux")
    if apt:
        stand_in(folder, "apt-get", f'echo "$DEBIAN_FRONTEND $*" >>"{folder}/apt.log"')
    return {"PATH": str(folder), "HOME": os.devnull}


@pytest.mark.parametrize(
    ("lacks", "machine_is", "code", "message"),
    [
        ("none", {}, 0, ""),
        (f'*"{VENV_CHECK}"*|*libusb*', {}, 0, ""),
        ("*libGL.so.1*|*libEGL*", {"user": 1000}, 1, "sudo apt-get update && sudo apt-get install"),
        ("*libGL.so.1*|*libEGL*", {"user": 1000}, 1, "libgl1 libegl1"),
        ("*libgomp*", {"apt": False}, 0, "warning"),
        ("*libgomp*", {"apt": False}, 0, "libgomp1"),
        ("*version_info*3,*11*", {}, 1, "make PYTHON="),
    ],
)
def test_root_installs_missing_packages_and_others_get_the_command(
    tmp_path: Path, lacks: str, machine_is: dict[str, Any], code: int, message: str
) -> None:
    done = run("/bin/bash", SCRIPT, code=code, env=machine(tmp_path, lacks=lacks, **machine_is))
    assert message in done.stdout + done.stderr
    installed = tmp_path / "apt.log"
    assert installed.exists() == (VENV_CHECK in lacks)
    if installed.exists():
        assert installed.read_text().splitlines() == [
            "noninteractive update -q",
            "noninteractive install -q -y --no-install-recommends python3.11-venv libusb-1.0-0",
        ]
    elif lacks == "none":
        assert done.stdout + done.stderr == ""


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
    stand_in(tmp_path, "uname", f"echo {machine}")
    stand_in(tmp_path, "grep", f"echo '{flags}'")
    stand_in(tmp_path, "cp", "true")
    stand_in(tmp_path, "edgegrasp", 'echo "${NUMBA_CPU_NAME-of its own}: $*"')
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CPU_NAME"}
    here = {**environment, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    started = run("/bin/sh", ROOT / "docker" / "start.sh", "--workers", "2", env=here)
    assert started.stdout == f"{loops}: serve --workers 2\n"
