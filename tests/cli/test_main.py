"""The program as a whole: its help, and what it says where something is missing."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from edgegrasp_cli import main

HEAVY = {"torch", "open3d", "grpc", "pybullet", "fastapi", "uvicorn", "matplotlib", "httpx"}


def loaded_by(*arguments: str) -> tuple[str, set[str]]:
    """What a command prints, and the modules that a fresh interpreter has loaded for it."""
    program = (
        "import sys\nfrom edgegrasp_cli.main import main\n"
        f"sys.argv = ['edgegrasp', *{arguments!r}]\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "print('LOADED', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown, _, loaded = done.stdout.rpartition("LOADED")
    return shown, set(loaded.split())


def test_help_lists_the_commands_and_loads_nothing_heavy() -> None:
    shown, loaded = loaded_by("--help")
    assert all(name in shown for name in main.COMMANDS)
    assert not loaded & (HEAVY | {"numpy", "scipy", "pydantic"})


@pytest.mark.parametrize("name", main.COMMANDS)
def test_help_of_a_command_loads_nothing_heavy(name: str) -> None:
    shown, loaded = loaded_by(name, "--help")
    assert name in shown
    assert not loaded & HEAVY


def test_unknown_command() -> None:
    result = CliRunner().invoke(main.app, ["detec"])
    assert result.exit_code == 2
    assert "Did you mean 'detect'?" in result.output


@pytest.mark.parametrize(
    ("missing", "words", "extra"),
    [
        ("edgegrasp_client", ["models", "--server", "127.0.0.1:1"], "service"),
        ("edgegrasp_sim.replay", ["replay", "attempt", "FOLDER"], "service,sim"),
        ("edgegrasp_cli.serve", ["serve"], "service"),
    ],
)
def test_a_missing_package_names_the_extra(
    missing: str, words: list[str], extra: str, refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    assert f"pip install 'edgegrasp[{extra}]'" in refused(*words)


def test_the_command_line_is_an_extra() -> None:
    program = "import sys; sys.modules['typer'] = None; import edgegrasp_cli.main"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert "pip install 'edgegrasp[cli]'" in done.stderr


def test_a_recorded_request_is_answered_again(
    run, refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = ModuleType("edgegrasp_service.recording")
    recording.replay = lambda path: f"{path.name}: the same"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "edgegrasp_service.recording", recording)
    assert run("replay", "request", tmp_path / "request.npz") == "request.npz: the same\n"

    def broken(path: Path) -> str:
        raise ValueError(f"{path.name} is no recorded request")

    recording.replay = broken  # type: ignore[attr-defined]
    assert "is no recorded request" in refused("replay", "request", tmp_path / "request.npz")
