"""edgegrasp.v1 keeps its promises: every kind of break is found, and additions are none."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from google.protobuf import descriptor_pb2

ROOT = Path(__file__).parents[2]
Field = descriptor_pb2.FieldDescriptorProto
File = descriptor_pb2.FileDescriptorProto


def load_script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


contract = load_script("contract")
COMMITTED = contract.read(ROOT / "proto" / contract.CONTRACT)


def test_the_generated_code_keeps_the_committed_contract() -> None:
    assert contract.breaks(COMMITTED, contract.current()) == []


def message(file: File, name: str) -> descriptor_pb2.DescriptorProto:
    return next(one for one in file.message_type if one.name == name)


def field(file: File, name: str, field_name: str) -> Field:
    return next(one for one in message(file, name).field if one.name == field_name)


def change(path: str, **values: object) -> Callable[[File], None]:
    """Set parts of the field `Message.field`."""
    owner, _, name = path.partition(".")

    def apply(file: File) -> None:
        for part, value in values.items():
            setattr(field(file, owner, name), part, value)

    return apply


def remove(parts: Callable[[File], Any], name: str) -> Callable[[File], None]:
    def apply(file: File) -> None:
        found = parts(file)
        found.remove(next(part for part in found if part.name == name))

    return apply


def fields(file: File) -> Any:
    return message(file, "Grasp").field


def reuse_number(file: File) -> None:
    remove(fields, "width")(file)
    fields(file).add(name="opening", number=4, type=Field.TYPE_FLOAT, label=1)


def leave_oneof(file: File) -> None:
    field(file, "DetectGraspsRequest", "encoded").ClearField("oneof_index")


def unreserve(file: File) -> None:
    del message(file, "DetectOptions").reserved_range[:]


def set_in(part: Callable[[File], Any], **values: object) -> Callable[[File], None]:
    def apply(file: File) -> None:
        for name, value in values.items():
            setattr(part(file), name, value)

    return apply


def first_method(file: File) -> Any:
    return file.service[0].method[0]


BREAKS = {
    "field removed": (remove(fields, "width"), "Grasp = 4 (name width"),
    "number used again": (reuse_number, "is now name opening"),
    "type changed": (change("Grasp.width", type=Field.TYPE_DOUBLE), "type "),
    "no longer repeated": (
        change("DetectGraspsResponse.warnings", label=Field.LABEL_OPTIONAL), "label"
    ),
    "left its oneof": (leave_oneof, "in oneof cloud) is now"),
    "message removed": (remove(lambda file: file.message_type, "Cone"), "message Cone () is gone"),
    "number no longer reserved": (unreserve, "DetectOptions reserves 10 () is gone"),
    "nested field removed": (
        remove(lambda file: message(file, "DetectGraspsResponse").nested_type[0].field, "value"),
        "CountsEntry = 2 (name value",
    ),
    "rpc removed": (
        remove(lambda file: file.service[0].method, "ScoreGrasps"),
        "rpc GraspService.ScoreGrasps (name",
    ),
    "rpc streams": (set_in(first_method, server_streaming=True), "server_streaming True"),
    "package renamed": (
        set_in(lambda file: file, package="edgegrasp.v2"),
        "package (edgegrasp.v1) is now edgegrasp.v2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BREAKS)
def test_every_break_is_found(name: str) -> None:
    apply, said = BREAKS[name]
    broken = File()
    broken.CopyFrom(COMMITTED)
    apply(broken)
    found = contract.breaks(COMMITTED, broken)
    assert any(said in line for line in found), found


def test_additions_are_no_breaks() -> None:
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
    remove(fields, "width")(broken)
    monkeypatch.setattr(contract, "current", lambda: broken)
    monkeypatch.setattr("sys.argv", ["contract.py", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"Grasp = 4 \(name width.* is gone"):
        contract.main()
    assert list(tmp_path.iterdir()) == []
