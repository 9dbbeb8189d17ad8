"""Generated pages are current, and the pages name what there is."""

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from edgegrasp_cli.flags import TOKEN_VARIABLE
from edgegrasp_client import conversions
from edgegrasp_service.settings import Settings

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text()


@pytest.fixture(autouse=True)
def scripts_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(DOCS)
    yield
    for name in [name for name in sys.modules if name.startswith("make_")]:
        del sys.modules[name]


@pytest.mark.parametrize("name", ["settings", "results"])
def test_generated_pages_are_current(name: str) -> None:
    page = importlib.import_module(f"make_{name}").page()
    assert (DOCS / f"{name}.md").read_text() == page, f"run: python docs/make_{name}.py"


def test_every_picture_is_shown_and_small(tmp_path: Path) -> None:
    shown = set(re.findall(r"\]\((\w+\.png)\)", (DOCS / "frames.md").read_text()))
    assert shown == {path.name for path in DOCS.glob("*.png")}
    importlib.import_module("make_pictures").main(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} <= shown
    assert all((DOCS / name).stat().st_size < 150_000 for name in shown)


def test_files_and_folders_that_pages_link_to_exist() -> None:
    for page in (ROOT / "README.md", *DOCS.glob("*.md")):
        for name in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text()):
            assert (page.parent / name).exists(), f"{page.name}: {name}"
    folders = re.findall(r"^\| `([a-z_/0-9]+/[a-z_/0-9]*)` \|", README, flags=re.MULTILINE)
    assert len(folders) >= 5
    assert [name for name in folders if not (ROOT / name).exists()] == []


def test_variables_that_the_pages_name_exist() -> None:
    known = {f"EDGEGRASP_{name.upper()}" for name in Settings.model_fields}
    beside = [ROOT / name for name in ("README.md", "Dockerfile", "docker/compose.yaml")]
    for page in (*DOCS.glob("*.md"), *beside):
        named = set(re.findall(r"\bEDGEGRASP_[A-Z_]+", page.read_text()))
        assert named <= {*known, "EDGEGRASP_CONFIG", TOKEN_VARIABLE, "EDGEGRASP_"}, page.name


def test_the_example_of_conversions_names_what_there_is() -> None:
    frames = (DOCS / "frames.md").read_text()
    imported = re.search(r"conversions import \(\n(.*?)\n\)", frames, flags=re.DOTALL)
    assert imported is not None
    assert all(hasattr(conversions, name) for name in re.findall(r"\w+", imported[1]))
