"""Grasps as protobuf messages, all at once: a table in the wire format, parsed row by row.

Made field by field they take more than twice as long, and a robot waits for it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.results import Grasp

_LENGTHS = {
    "T_cloud_hand": 16, "T_cloud_tcp": 16, "approach_point": 3, "contact_point": 3,
    "approach_direction": 3,
}  # fmt: skip
_VARINT, _LENGTH_DELIMITED, _FOUR_BYTES = 0, 2, 5  # wire types
_NAMES = tuple(grasp_pb2.Grasp.DESCRIPTOR.fields_by_name)


def grasp_messages(grasps: Sequence[Grasp]) -> list[grasp_pb2.Grasp]:
    """Grasps as messages."""
    if not grasps:
        return []
    rows = np.full(len(grasps), _NO_GRASP)
    for name in _NAMES:
        values = np.array([getattr(grasp, name) for grasp in grasps])
        rows[name] = values.reshape(rows[name].shape)
    data, size = rows.tobytes(), rows.itemsize
    return [
        grasp_pb2.Grasp.FromString(data[start : start + size])
        for start in range(0, len(data), size)
    ]


def _no_grasp() -> NDArray[np.void]:
    """() a message of zeros: each value under its field's name, between keys and lengths."""
    layout: list[tuple[str, str, int]] = []
    constants: dict[str, int] = {}
    for name, field in grasp_pb2.Grasp.DESCRIPTOR.fields_by_name.items():
        length = _LENGTHS.get(name, 1)
        value = "<f4"
        wire_type = _FOUR_BYTES
        if field.type == field.TYPE_BOOL:
            value, wire_type = "u1", _VARINT
        if name in _LENGTHS:
            wire_type = _LENGTH_DELIMITED
        layout.append((f"key of {name}", "u1", 1))
        constants[f"key of {name}"] = field.number << 3 | wire_type
        if name in _LENGTHS:
            layout.append((f"length of {name}", "u1", 1))
            constants[f"length of {name}"] = 4 * length
        layout.append((name, value, length))
    message = np.zeros((), layout)
    for name, constant in constants.items():
        message[name] = constant
    return message


_NO_GRASP = _no_grasp()
