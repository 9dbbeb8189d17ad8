"""Read an .xyz file from memory: text, one point a line."""

from collections.abc import Callable

import numpy as np

from edgegrasp_model.cloud_input import CloudInput
from edgegrasp_model.errors import InvalidRequest

FIX = "Send lines of three numbers: x y z in metres. Normals and colours go into a .ply file."


def read_xyz(data: bytes, check_count: Callable[[int], None]) -> CloudInput:
    """Read x, y, z of each line; empty lines and those that start with # are skipped.

    Args:
        data: The file's bytes.
        check_count: Called with the number of points before they are converted.

    Returns:
        Points (N, 3) float64.

    Raises:
        InvalidRequest: A line does not hold three numbers, or there is none.
    """
    lines = [line.split() for line in data.splitlines()]
    rows = [words for words in lines if words and not words[0].startswith(b"#")]
    check_count(len(rows))
    if not rows:
        raise InvalidRequest("cloud", f"{len(data)} bytes without a line of an .xyz file", FIX)
    for number, words in enumerate(lines, start=1):
        if words and not words[0].startswith(b"#") and len(words) != 3:
            value = f"line {number} with {len(words)} words in an .xyz file"
            raise InvalidRequest("cloud", value, FIX)
    try:
        return CloudInput(np.array(rows, dtype="S32").astype(np.float64))
    except ValueError:
        raise InvalidRequest("cloud", "text among the numbers of an .xyz file", FIX) from None
