"""The tree holds what it should, and nothing of the machine it was made on."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Package indexes and absolute paths of somebody's machine; in pieces, or this file would match.
HOSTS = ["pypi" + r"\.org", "python" + "hosted", "npm" + r"js\.org", r"deb\." + "debian"]
FOREIGN = re.compile(
    "|".join([*HOSTS, "--index" + "-url", r"(?<![\w.}])/(?:work|root|home|mnt)/\w"])
)


def tracked_files() -> list[Path]:
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True
        )
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout, so there is no list of tracked files")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]


def text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return ""


def test_no_tracked_file_names_a_registry_or_a_path_of_one_machine() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in tracked_files()
        for match in FOREIGN.finditer(text_of(path))
    ]
    assert found == []


def test_tracked_files_are_small_enough_for_a_clone() -> None:
    large = [path.name for path in tracked_files() if path.stat().st_size > 20 * 2**20]
    assert large == []


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
