"""What must stay quick to import stays free of heavy packages."""

import subprocess
import sys

import pytest

from edgegrasp_cli.main import COMMANDS

HEAVY = {"fastapi", "grpc", "matplotlib", "open3d", "pybullet", "scipy", "torch", "uvicorn"}


def heavy_modules_after(code: str) -> set[str]:
    """Names in HEAVY that are loaded once a fresh interpreter has run the code."""
    report = "import sys; print('\\nLOADED', *sys.modules)"
    script = f"try:\n    {code}\nexcept SystemExit as end:\n    assert not end.code\n{report}"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return HEAVY & set(done.stdout.rpartition("\nLOADED")[2].split())


@pytest.mark.parametrize("arguments", [[], *([name] for name in COMMANDS)], ids=str)
def test_help_loads_nothing_heavy(arguments: list[str]) -> None:
    argv = ["edgegrasp", *arguments, "--help"]
    code = f"import sys; sys.argv = {argv!r}; from edgegrasp_cli.main import main; main()"
    assert heavy_modules_after(code) == set()


def test_client_loads_only_its_transports() -> None:
    assert heavy_modules_after("import edgegrasp_client") <= {"grpc"}


def test_a_heavy_module_would_be_noticed() -> None:
    assert heavy_modules_after("import scipy") == {"scipy"}
