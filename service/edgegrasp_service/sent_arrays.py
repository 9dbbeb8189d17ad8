"""Arrays that come beside a cloud, as each transport carries them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest, brief
from edgegrasp_service.npy_file import read_npy

Array = NDArray[Any]

BLOCK = 4096  # rows of lists
# Name: numbers to a row of the cloud, and their type where they come packed.
PER_POINT = {
    "normals": (3, "<f4"),
    "colors": (3, "<f4"),
    "segment_ids": (1, "<i4"),
    "view_ids": (1, "<i4"),
}


@dataclass(frozen=True)
class PackedArray:
    """Little-endian numbers."""

    data: bytes

    def decode(self, field: str, max_points: int) -> Array:
        """(N, 3) float32 or (N,) int32; raises InvalidRequest for a broken number."""
        width, dtype = PER_POINT[field]
        if len(self.data) % (4 * width):
            value = f"{len(self.data)} bytes, which are no whole number of rows"
            kind = "float32" if dtype == "<f4" else "int32"
            fix = f"Send {4 * width} bytes a row: little-endian {kind}."
            raise InvalidRequest(field, value, fix)
        array = np.frombuffer(self.data, dtype=dtype)
        return array.reshape(-1, 3) if width == 3 else array


@dataclass(frozen=True)
class ListArray:
    """Lists of a JSON body."""

    values: object

    def decode(self, field: str, max_points: int) -> Array:
        """An array of the lists' shape; raises InvalidRequest for what is no array of numbers."""
        return array_from_lists(field, self.values)


@dataclass(frozen=True)
class NpyArray:
    """An .npy file."""

    data: bytes

    def decode(self, field: str, max_points: int) -> Array:
        """The array in it; raises InvalidRequest for a file that is none."""
        return read_npy(self.data, max_points, field)


SentArray = PackedArray | ListArray | NpyArray


def array_from_lists(field: str, values: object) -> Array:
    """Lists of numbers as an array: int64 where all are whole, float64 else.

    Raises:
        InvalidRequest: No list, rows of different lengths, or something other than numbers.
    """
    if not isinstance(values, list):
        raise InvalidRequest(field, brief(values), "Send a list of numbers, or of lists of them.")
    return numbers_from_lists(field, values) if values else np.empty(0)


def numbers_from_lists(field: str, values: list[Any], holes: bool = False) -> Array:
    """As `array_from_lists`, for a list; with `holes`, None is NaN in lists three deep.

    Raises:
        InvalidRequest: Rows of different lengths, or something other than numbers.
    """
    # A block at a time, between which other threads run; numpy lets none while it reads lists.
    blocks = [
        _objects(field, values[start : start + BLOCK], holes)
        for start in range(0, len(values), BLOCK)
    ]
    if len({block.shape[1:] for block, _ in blocks}) > 1:
        raise _ragged(field, holes)
    dtype = np.int64 if all(kinds == {int} for _, kinds in blocks) else np.float64
    try:
        return np.concatenate([block.astype(dtype) for block, _ in blocks])
    except OverflowError:
        bad = next(row for row in values if _holds(row, _too_large))
        raise InvalidRequest(field, brief(bad), "Send whole numbers of 64 bits.") from None


def _objects(field: str, values: list[Any], holes: bool) -> tuple[Array, set[type]]:
    """Numbers as they are, and of which types; raises as `numbers_from_lists`."""
    # As objects: an array of text would give every element the room of the longest.
    try:
        array = np.array(values, dtype=object)
    except ValueError:
        raise _ragged(field, holes) from None
    kinds = set(map(type, array.ravel().tolist()))
    if list in kinds:
        raise _ragged(field, holes)
    allowed = {int, float, type(None)} if holes and array.ndim == 3 else {int, float}
    if not kinds <= allowed:
        bad = next(row for row in values if _holds(row, lambda part: type(part) not in allowed))
        raise InvalidRequest(field, brief(bad), "Send numbers only.")
    return array, kinds


def _ragged(field: str, holes: bool) -> InvalidRequest:
    fix = "Send [x, y, z] rows." if holes else "Send rows of one length."
    return InvalidRequest(field, "rows of different lengths", fix)


def _holds(value: object, of_kind: Callable[[object], bool]) -> bool:
    """Whether any number in lists of any depth is of a kind."""
    if isinstance(value, list):
        return any(_holds(part, of_kind) for part in value)
    return of_kind(value)


def _too_large(value: object) -> bool:
    return isinstance(value, int) and not -(2**63) <= value < 2**63
