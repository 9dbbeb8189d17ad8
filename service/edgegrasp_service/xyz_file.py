"""Read an .xyz file from memory: text, one point a line."""

from collections.abc import Callable

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.point_records import numbers_from_words

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
    numbers: list[bytes] = []
    for row, line in enumerate(data.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith(b"#"):
            continue
        if len(words) != 3:
            value = f"line {row} with {len(words)} words in an .xyz file"
            raise InvalidRequest("cloud", value, FIX)
        numbers += words
    check_count(len(numbers) // 3)
    if not numbers:
        raise InvalidRequest("cloud", f"{len(data)} bytes without a line of an .xyz file", FIX)
    return CloudInput(numbers_from_words(numbers, ".xyz").reshape(-1, 3))
