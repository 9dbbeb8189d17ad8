"""Rows of point cloud files: fixed records, in binary or as text."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest

MAX_WORD = 48  # characters; %.40f fits


def read_binary_records(
    body: bytes, record: np.dtype[Any], count: int, kind: str
) -> NDArray[np.void]:
    """Read `count` records.

    Raises:
        InvalidRequest: The body is too short for them.
    """
    expected = count * record.itemsize
    if len(body) < expected:
        value = f"{len(body)} bytes of data where the {kind} header promises {expected}"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    return np.frombuffer(body, dtype=record, count=count).astype(record.newbyteorder("="))


def read_ascii_records(
    body: bytes, record: np.dtype[Any], count: int, kind: str
) -> NDArray[np.void]:
    """Read `count` records of whitespace-separated numbers.

    Raises:
        InvalidRequest: There are too few of them, or one is no number.
    """
    names = record.names or ()
    expected = count * len(names)
    if expected > len(body):  # each number takes a byte at least
        value = f"{len(body)} bytes of data where the {kind} header promises {count} rows"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    words = body.split(None, expected)[:expected]
    if len(words) < expected:
        value = f"{len(words)} numbers where the {kind} header promises {expected}"
        raise InvalidRequest("cloud", value, "Send the whole file.")
    table = numbers_from_words(words, kind).reshape(count, len(names))
    rows = np.empty(count, dtype=record)
    with np.errstate(all="ignore"):
        for column, name in enumerate(names):
            rows[name] = table[:, column]
    return rows


def numbers_from_words(words: list[bytes], kind: str) -> NDArray[np.float64]:
    """Numbers written as text, in a flat array.

    Raises:
        InvalidRequest: A word is no number, or longer than any number needs to be.
    """
    longest = max(map(len, words), default=1)  # every element of the array has the room of that
    if longest > MAX_WORD:
        value = f"a word of {longest} characters in a {kind} file"
        raise InvalidRequest("cloud", value, f"Send numbers of {MAX_WORD} characters at most.")
    try:
        return np.array(words, dtype=f"S{longest}").astype(np.float64)
    except ValueError:
        value = f"text among the numbers of a {kind} file"
        raise InvalidRequest("cloud", value, "Send numbers only.") from None


def columns(rows: NDArray[np.void], names: tuple[str, ...]) -> NDArray[Any] | None:
    """Fields of the rows side by side; None where one of them is missing."""
    if not set(names) <= set(rows.dtype.names or ()):
        return None
    return np.stack([rows[name] for name in names], axis=-1)


def unpacked_colors(packed: NDArray[Any]) -> NDArray[np.uint8]:
    """Red, green and blue out of 0x00RRGGBB, which PCL and ROS keep in a float32 or uint32.

    Args:
        packed: (...) of 4 bytes each, native byte order.

    Returns:
        (..., 3)
    """
    values = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([values >> shift & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
