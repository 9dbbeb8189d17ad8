"""edgegrasp.v1 keeps its promises: every kind of break is found, and additions are none."""

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

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


def remove_field(file: File) -> None:
    fields = message(file, "Grasp").field
    fields.remove(field(file, "Grasp", "width"))


def reuse_number(file: File) -> None:
    remove_field(file)
    message(file, "Grasp").field.add(name="opening", number=4, type=Field.TYPE_FLOAT, label=1)


def leave_oneof(file: File) -> None:
    field(file, "DetectGraspsRequest", "encoded").ClearField("oneof_index")


def rename_oneof(file: File) -> None:
    message(file, "DetectGraspsRequest").oneof_decl[0].name = "source"


def remove_message(file: File) -> None:
    file.message_type.remove(message(file, "Cone"))


def unreserve(file: File) -> None:
    del message(file, "DetectOptions").reserved_range[:]


def remove_map_entry_field(file: File) -> None:
    del message(file, "DetectGraspsResponse").nested_type[0].field[1]


def remove_rpc(file: File) -> None:
    methods = file.service[0].method
    methods.remove(next(method for method in methods if method.name == "ScoreGrasps"))


def remove_service(file: File) -> None:
    del file.service[:]


def other_answer(file: File) -> None:
    file.service[0].method[0].output_type = ".edgegrasp.v1.ScoreGraspsResponse"


def stream_answers(file: File) -> None:
    file.service[0].method[0].server_streaming = True


def rename_package(file: File) -> None:
    file.package = "edgegrasp.v2"


BREAKS = {
    "field removed": (remove_field, "Grasp = 4 (name width"),
    "number used again": (reuse_number, "is now name opening"),
    "field renamed": (change("Grasp.width", name="opening"), "is now name opening"),
    "field renumbered": (change("Grasp.width", number=99), "Grasp = 4 (name width"),
    "type changed": (change("Grasp.width", type=Field.TYPE_DOUBLE), "type "),
    "message type changed": (
        change("DetectOptions.up", type_name=".edgegrasp.v1.Quaternion"), "type_name",
    ),
    "no longer repeated": (
        change("DetectGraspsResponse.warnings", label=Field.LABEL_OPTIONAL), "label"
    ),
    "no longer optional": (
        change("DetectOptions.seed", proto3_optional=False), "proto3_optional"
    ),
    "left its oneof": (leave_oneof, "in oneof cloud) is now"),
    "oneof renamed": (rename_oneof, "in oneof source"),
    "message removed": (remove_message, "message Cone () is gone"),
    "number no longer reserved": (unreserve, "DetectOptions reserves 10 () is gone"),
    "nested field removed": (remove_map_entry_field, "CountsEntry = 2 (name value"),
    "rpc removed": (remove_rpc, "rpc GraspService.ScoreGrasps (name"),
    "service removed": (remove_service, "rpc GraspService.DetectGrasps (name"),
    "rpc answers otherwise": (other_answer, "output_type"),
    "rpc streams": (stream_answers, "server_streaming True"),
    "package renamed": (rename_package, "package (edgegrasp.v1) is now edgegrasp.v2"),
}  # fmt: skip


@pytest.mark.parametrize("name", BREAKS)
def test_every_break_is_found(name: str) -> None:
    apply, said = BREAKS[name]
    broken = File()
    broken.CopyFrom(COMMITTED)
    apply(broken)
    found = contract.breaks(COMMITTED, broken)
    assert any(said in line for line in found), found


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([("ONE", 1)], "Kind.TWO (= 2) is gone"),
        ([("ONE", 1), ("TWO", 3)], "Kind.TWO (= 2) is now = 3"),
        ([("ONE", 1), ("DOS", 2)], "Kind.TWO (= 2) is gone"),
        (None, "enum Kind () is gone"),
    ],
)
def test_enum_breaks_are_found(values: list[tuple[str, int]] | None, said: str) -> None:
    """edgegrasp.v1 has no enum yet."""

    def with_enum(names: list[tuple[str, int]] | None) -> File:
        file = File()
        file.CopyFrom(COMMITTED)
        if names is not None:
            enum = file.enum_type.add(name="Kind")
            for name, number in names:
                enum.value.add(name=name, number=number)
        return file

    old = with_enum([("ONE", 1), ("TWO", 2)])
    assert contract.breaks(old, with_enum([("ONE", 1), ("TWO", 2), ("THREE", 3)])) == []
    assert any(said in line for line in contract.breaks(old, with_enum(values)))


def test_additions_are_no_breaks() -> None:
    more = File()
    more.CopyFrom(COMMITTED)
    message(more, "Grasp").field.add(name="hue", number=99, type=Field.TYPE_FLOAT, label=1)
    more.message_type.add(name="Extra")
    more.service[0].method.add(name="Extra", input_type=".x", output_type=".y")
    more.service.add(name="ExtraService")
    message(more, "Grasp").reserved_range.add(start=50, end=60)
    assert contract.breaks(COMMITTED, more) == []


def test_a_break_is_not_written_into_the_contract(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = contract.current()
    remove_field(broken)
    monkeypatch.setattr(contract, "current", lambda: broken)
    monkeypatch.setattr("sys.argv", ["contract.py", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"Grasp = 4 \(name width.* is gone"):
        contract.main()
    assert list(tmp_path.iterdir()) == []


def test_style() -> None:
    """What `buf lint` asks of names: one spelling for each kind of thing."""
    file = contract.current()
    assert re.fullmatch(r"[a-z]+\.v\d+", file.package)
    assert file.name == f"{file.package.replace('.', '/')}/grasp.proto"
    for service in file.service:
        assert service.name.endswith("Service")
        for method in service.method:
            assert re.fullmatch(r"[A-Z][A-Za-z]+", method.name)
            answer = method.name.removesuffix("Stream")
            assert method.input_type.endswith((f".{method.name}Request", f".{answer}Request"))
            assert method.output_type.endswith((f".{method.name}Response", f".{answer}Response"))
    for one in file.message_type:
        assert re.fullmatch(r"[A-Z][A-Za-z0-9]+", one.name)
        for part in one.field:
            # T_cloud_hand names frames as the equations do.
            assert re.fullmatch(r"(T_)?[a-z][a-z0-9_]*", part.name), f"{one.name}.{part.name}"
    for enum in file.enum_type:
        prefix = re.sub(r"(?<!^)(?=[A-Z])", "_", enum.name).upper()
        assert all(value.name.startswith(f"{prefix}_") for value in enum.value)
        assert enum.value[0].name == f"{prefix}_UNSPECIFIED"
