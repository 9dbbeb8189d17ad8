"""An option is defined once: everything else about it is generated."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from pydantic import Field

from edgegrasp.v1.grasp_pb2 import DetectOptions as DetectMessage
from edgegrasp_model.options import DetectOptions, Number

ROOT = Path(__file__).parents[2]


@pytest.fixture
def script() -> ModuleType:
    path = ROOT / "scripts" / "generate_options.py"
    spec = importlib.util.spec_from_file_location("generate_options", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_new_option_reaches_the_message_the_client_and_the_page(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    class More(DetectOptions):
        """Options of one detection."""

        force: Number | None = Field(default=None, description="newtons; null: any")

    assert "double force" not in script.proto()
    monkeypatch.setattr(script, "DetectOptions", More)
    written = re.search(
        r"  // Newtons; absent: any\.\n  optional double force = (\d+);", script.proto()
    )
    assert written is not None
    assert int(written[1]) > max(field.number for field in DetectMessage.DESCRIPTOR.fields)
    assert "    # newtons; None: any\n    force: float | None\n" in script.client_types()
    assert "| `force` | number or null | `double` |" in script.page()
