"""edgegrasp.v1 keeps its promises: every kind of break is found, and additions are none."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROTO = Path(__file__).parents[2] / "proto"
FILE, CONTRACT = Path("edgegrasp/v1/grasp.proto"), PROTO / "edgegrasp/v1/contract.json"
BUF = shutil.which("buf", path=str(Path(sys.executable).parent))

pytestmark = pytest.mark.skipif(BUF is None, reason="buf is not installed: make lint installs it")


def breaks(folder: Path, old: str = "", new: str = "") -> str:
    """What of the contract a caller would miss if the definitions were changed."""
    text = (PROTO / FILE).read_text()
    assert old in text
    (folder / FILE).parent.mkdir(parents=True, exist_ok=True)
    (folder / FILE).write_text(text.replace(old, new, 1))
    words = [str(BUF), "breaking", str(folder), "--against", str(CONTRACT)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.returncode == (100 if run.stdout else 0), run.stderr
    return run.stdout


CALL = "  rpc ScoreGrasps(ScoreGraspsRequest) returns (ScoreGraspsResponse);\n"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  float width = 4;\n", "", '"width" on message "Grasp" was deleted'),
        ("float width = 4;", "float opening = 4;", 'changed name from "width" to "opening"'),
        ("  reserved 10;\n", "", 'reserved range "[10]" on message "DetectOptions"'),
        (CALL, "", 'RPC "ScoreGrasps" on service "GraspService" was deleted'),
    ],
)
def test_every_break_is_found(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert said in breaks(tmp_path, old, new)


def test_the_definitions_and_additions_keep_the_committed_contract(tmp_path: Path) -> None:
    assert breaks(tmp_path) == ""
    field, service = "  float width = 4;\n", "service GraspService {\n"
    assert breaks(tmp_path, field, f"{field}  float hue = 99;\n  reserved 50 to 60;\n") == ""
    call = "  rpc More(Extra) returns (Extra);\n"
    extra = f"message Extra {{}}\nservice ExtraService {{\n{call}}}\n"
    assert breaks(tmp_path, service, f"{extra}{service}{call}") == ""
