"""docs/ says what the code says, and shows what it names."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from edgegrasp_client import conversions
from edgegrasp_model.gripper import gripper_names
from edgegrasp_model.options import GripperGeometry

DOCS = Path(__file__).parents[2] / "docs"
FRAMES = (DOCS / "frames.md").read_text()


def pictures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_pictures", DOCS / "make_pictures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_picture_is_shown_made_by_the_script_and_small(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra `view` is not installed")
    shown = set(re.findall(r"\]\((\w+\.png)\)", FRAMES))
    assert shown == {path.name for path in DOCS.glob("*.png")}
    pictures().main(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == shown
    assert all((DOCS / name).stat().st_size < 150_000 for name in shown)


def test_frames_name_every_gripper_and_its_fields() -> None:
    named = re.findall(r"^\| `([a-z0-9-]+)` \|", FRAMES, flags=re.MULTILINE)
    assert set(gripper_names()) <= set(named)
    words = set(re.findall(r"`([\w.]+)`", FRAMES))
    parts = {"hand": "hand.boxes", "finger": "finger.boxes", "swing": "swing.radius"}
    assert {parts.get(name, name) for name in GripperGeometry.model_fields} <= words


def test_the_example_of_conversions_names_what_there_is() -> None:
    imported = re.search(r"conversions import \(\n(.*?)\n\)", FRAMES, flags=re.DOTALL)
    assert imported is not None
    assert set(re.findall(r"\w+", imported[1])) <= set(conversions.__all__)
