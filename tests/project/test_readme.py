"""The README's tables say what the code says."""

import re
from pathlib import Path

import pytest

from edgegrasp_model.options import DetectOptions
from edgegrasp_service.errors import STATUS, kind_of
from edgegrasp_service.settings import Settings

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def rows(heading: str) -> dict[str, list[str]]:
    """Cells of the tables under a heading, by each code word in a row's first cell."""
    section = README.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    table = {}
    for line in section.splitlines():
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            table |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[0]), cells[1:])
    return table


def test_options_table_names_options_that_exist() -> None:
    named = set(rows("Options"))
    assert named <= set(DetectOptions.model_fields)
    assert {"model", "viewpoint", "support", "collision", "top_k"} <= named


@pytest.mark.parametrize("name", ["num_approach_points", "num_candidates", "seed", "top_k"])
def test_options_table_gives_the_default(name: str) -> None:
    assert rows("Options")[name][0] == str(DetectOptions.model_fields[name].default)


def test_errors_table_is_the_table_of_the_service() -> None:
    expected = {
        kind_of(error): [str(status), code.name] for error, (code, status) in STATUS.items()
    }
    assert {kind: cells[:2] for kind, cells in rows("Errors").items()} == expected


def test_settings_table_names_settings_that_exist() -> None:
    named = {name.removeprefix("EDGEGRASP_").lower() for name in rows("Run a server")}
    assert named <= set(Settings.model_fields)
    assert {"host", "http_port", "grpc_port", "weights", "max_body_bytes"} <= named


def test_files_and_folders_that_the_readme_names_exist() -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    folders = re.findall(r"^\| `([a-z_/0-9]+/[a-z_/0-9]*)` \|", README, flags=re.MULTILINE)
    assert len(links) >= 1
    assert len(folders) >= 8
    for name in [*links, *folders]:
        assert (ROOT / name).exists(), name
