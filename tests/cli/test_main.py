import subprocess
import sys

import pytest
from typer.testing import CliRunner

from edgegrasp_cli import main

HEAVY = ("torch", "open3d", "grpc", "pybullet", "numpy", "fastapi", "scipy", "httpx")


def test_help_lists_the_commands_and_imports_nothing_heavy() -> None:
    program = (
        "import sys\nfrom edgegrasp_cli.main import main\nsys.argv = ['edgegrasp', '--help']\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print('imported', *sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    shown, _, imported = done.stdout.partition("imported ")
    for name in main.COMMANDS:
        assert name in shown
    assert not set(HEAVY) & set(imported.split())


@pytest.mark.parametrize("name", ["serve", "detect", "models"])
def test_commands_show_their_own_help(name: str) -> None:
    result = CliRunner().invoke(main.app, [name, "--help"])
    assert result.exit_code == 0
    assert "--weights" in result.output


def test_unknown_command() -> None:
    result = CliRunner().invoke(main.app, ["detec"])
    assert result.exit_code == 2
    assert "Did you mean 'detect'?" in result.output


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "edgegrasp_client", None)
    result = CliRunner().invoke(main.app, ["models", "--server", "127.0.0.1:1"])
    assert result.exit_code == 1
    assert "pip install 'edgegrasp[service]'" in result.output


def test_a_missing_package_of_a_command_in_a_group_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    monkeypatch.setitem(sys.modules, "edgegrasp_sim.replay", None)
    result = CliRunner().invoke(main.app, ["replay", "attempt", str(tmp_path)])
    assert result.exit_code == 1
    assert "pip install 'edgegrasp[sim]'" in result.output


def test_a_command_that_is_not_there_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "edgegrasp_cli.serve", None)
    result = CliRunner().invoke(main.app, ["serve"])
    assert result.exit_code == 1
    assert "pip install 'edgegrasp[service]'" in result.output


def test_the_command_line_is_an_extra() -> None:
    program = "import sys; sys.modules['typer'] = None; import edgegrasp_cli.main"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert "pip install 'edgegrasp[cli]'" in done.stderr
