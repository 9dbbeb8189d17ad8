"""edgegrasp.v1 keeps its promises: every kind of break is found, and additions are none."""

from collections.abc import Callable
from typing import Any

import pytest
from google.protobuf import descriptor_pb2
from scripts import contract

Field = descriptor_pb2.FieldDescriptorProto
File = descriptor_pb2.FileDescriptorProto


COMMITTED = contract.read(contract.ROOT / "proto" / contract.CONTRACT)


def message(file: File, name: str) -> descriptor_pb2.DescriptorProto:
    return next(one for one in file.message_type if one.name == name)


def removed(parts: Any, name: str) -> None:
    parts.remove(next(part for part in parts if part.name == name))


def without_a_field(file: File) -> None:
    removed(message(file, "Grasp").field, "width")


def number_used_again(file: File) -> None:
    without_a_field(file)
    message(file, "Grasp").field.add(name="opening", number=4, type=Field.TYPE_FLOAT, label=1)


def number_not_reserved(file: File) -> None:
    del message(file, "DetectOptions").reserved_range[:]


def without_a_call(file: File) -> None:
    removed(file.service[0].method, "ScoreGrasps")


BREAKS = {
    without_a_field: "Grasp.field.4 (name width",
    number_used_again: "is now name opening",
    number_not_reserved: "messageType.DetectOptions.reservedRange.",
    without_a_call: "service.GraspService.method.ScoreGrasps (name",
}


@pytest.mark.parametrize("apply", BREAKS)
def test_every_break_is_found(apply: Callable[[File], None]) -> None:
    broken = File()
    broken.CopyFrom(COMMITTED)
    apply(broken)
    found = contract.breaks(COMMITTED, broken)
    assert any(BREAKS[apply] in line for line in found), found


def test_the_generated_code_and_additions_keep_the_committed_contract() -> None:
    assert contract.breaks(COMMITTED, contract.current()) == []
    more = File()
    more.CopyFrom(COMMITTED)
    message(more, "Grasp").field.add(name="hue", number=99, type=Field.TYPE_FLOAT, label=1)
    more.message_type.add(name="Extra")
    more.service[0].method.add(name="Extra", input_type=".x", output_type=".y")
    more.service.add(name="ExtraService")
    message(more, "Grasp").reserved_range.add(start=50, end=60)
    assert contract.breaks(COMMITTED, more) == []


def test_a_break_is_not_written_into_the_contract(tmp_path, monkeypatch) -> None:
    broken = contract.current()
    without_a_field(broken)
    monkeypatch.setattr(contract, "current", lambda: broken)
    monkeypatch.setattr("sys.argv", ["contract.py", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"Grasp.field.4 \(name width.* is gone"):
        contract.main()
    assert list(tmp_path.iterdir()) == []
