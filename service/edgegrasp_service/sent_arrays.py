"""Arrays that come beside a cloud, as each transport carries them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_service.npy_file import read_npy

Array = NDArray[Any]

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
    """Lists of numbers as an array.

    Raises:
        InvalidRequest: No list, rows of different lengths, or something other than numbers.
    """
    if not isinstance(values, list):
        raise InvalidRequest(field, brief(values), "Send a list of numbers, or of lists of them.")
    try:
        array = np.array(values) if values else np.empty(0)
    except ValueError:
        raise InvalidRequest(
            field, "rows of different lengths", "Send rows of one length."
        ) from None
    if array.dtype.kind not in "iuf":
        bad = next((row for row in values if not _is_numbers(row)), values[0])
        raise InvalidRequest(field, brief(bad), "Send numbers only.")
    return array


def brief(value: object) -> str:
    """A value as it goes into an error."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _is_numbers(value: object) -> bool:
    if isinstance(value, list):
        return all(_is_numbers(part) for part in value)
    return type(value) in (int, float)
