"""scripts/system_packages.sh on machines that lack something, played by stand-in programs."""

import os
import subprocess
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "scripts" / "system_packages.sh"
VENV_CHECK = "import ensurepip, venv"


def stand_in(folder: Path, name: str, body: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/bash\n{body}\n")
    path.chmod(0o755)


def machine(folder: Path, *, lacks: str, user: int, apt: bool = True) -> dict[str, str]:
    """A folder of stand-ins as PATH; the interpreter fails where a bash pattern matches."""
    stand_in(
        folder,
        "python3",
        f'case "$*" in {lacks}) exit 1;; *print*) echo python3.11-venv;; esac',
    )
    stand_in(folder, "id", f"echo {user}")
    stand_in(folder, "uname", "echo Linux")
    if apt:
        stand_in(folder, "apt-get", f'echo "$DEBIAN_FRONTEND $*" >>"{folder}/apt.log"')
    return {"PATH": str(folder), "HOME": os.devnull}


def run(environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/bash", SCRIPT], env=environment, capture_output=True, text=True, check=False
    )


def test_says_nothing_when_nothing_is_missing(tmp_path: Path) -> None:
    done = run(machine(tmp_path, lacks="none", user=0))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not (tmp_path / "apt.log").exists()


def test_root_installs_exactly_what_is_missing_without_questions(tmp_path: Path) -> None:
    done = run(machine(tmp_path, lacks=f'*"{VENV_CHECK}"*|*libusb*', user=0))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "apt.log").read_text().splitlines() == [
        "noninteractive update -q",
        "noninteractive install -q -y --no-install-recommends python3.11-venv libusb-1.0-0",
    ]


def test_another_user_is_told_the_command(tmp_path: Path) -> None:
    done = run(machine(tmp_path, lacks="*libGL.so.1*|*libEGL*", user=1000))
    assert done.returncode == 1
    assert "sudo apt-get update && sudo apt-get install" in done.stderr
    assert "libgl1 libegl1" in done.stderr
    assert not (tmp_path / "apt.log").exists()


def test_without_apt_the_packages_are_named_and_set_up_goes_on(tmp_path: Path) -> None:
    done = run(machine(tmp_path, lacks="*libgomp*", user=0, apt=False))
    assert done.returncode == 0
    assert "libgomp1" in done.stdout
    assert "warning" in done.stderr


def test_an_old_python_is_refused_with_the_way_out(tmp_path: Path) -> None:
    done = run(machine(tmp_path, lacks="*version_info*3,*11*", user=0))
    assert done.returncode == 1
    assert "make PYTHON=" in done.stderr
