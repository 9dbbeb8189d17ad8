"""The Python of docs/integrations.md runs, one block after the other."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "integrations.md").read_text()


class Part(SimpleNamespace):
    """A message: any field is there once it is set, and a message before."""

    def __getattr__(self, name: str) -> "Part":
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Part())
        return self.__dict__[name]


def set_fields(message: object, fields: dict) -> None:
    for name, value in fields.items():
        if isinstance(value, dict):
            set_fields(getattr(message, name), value)
        else:
            setattr(message, name, value)


def test_the_code_of_the_page_runs(start_dummy, tmp_path, monkeypatch) -> None:
    """MoveIt is a stand-in that records its calls; the server has the dummy detector."""
    pytest.importorskip("yaml", reason="the extra `yaml` is not installed")
    constructor = MagicMock()
    for name, module in (
        ("geometry_msgs", MagicMock()),
        ("geometry_msgs.msg", SimpleNamespace(PoseStamped=Part)),
        ("moveit", MagicMock()),
        ("rosidl_runtime_py", SimpleNamespace(set_message_fields=set_fields)),
        ("moveit.task_constructor", constructor),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    names = {
        "points": rng.uniform(-0.1, 0.1, (500, 3)).astype(np.float32),
        "task": MagicMock(),
    }
    blocks = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(blocks) == 5
    outcomes = tmp_path / "outcomes.jsonl"
    with start_dummy("--outcomes-file", str(outcomes)) as server:
        names["server"] = server.http_url
        for block in blocks:
            exec(block.replace("127.0.0.1:50051", server.grpc_address), names)
    hand = names["detection"].grasps[0].T_cloud_hand
    added = [call.args[0] for call in names["grasps"].insert.call_args_list]
    assert len(added) == len(names["detection"].grasps)
    first = constructor.stages.GeneratePose.return_value.pose.pose.position
    assert first.z == pytest.approx(names["detection"].grasps[-1].T_cloud_hand[2, 3])
    np.testing.assert_allclose(
        names["fields"][0]["grasp_pose"]["pose"]["position"]["x"], hand[0, 3]
    )
    assert len(names["scoring"].evaluations) == len(names["detection"].grasps)
    assert "object_frame: mug" in Path("mug.yaml").read_text()
    assert outcomes.read_text().count("\n") == 1
