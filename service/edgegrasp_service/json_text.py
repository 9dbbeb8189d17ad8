"""Read JSON that others sent: within the memory it is worth, and without holding others up."""

import gc
import json
from typing import Any

from edgegrasp_model.errors import InvalidRequest

MAX_SHORT_LISTS = 20_000  # edges take 6 bytes each
LONG = 64 * 1024  # bytes, which take a millisecond


def read_json(field: str, text: bytes) -> Any:
    """What a text says.

    Args:
        field: What it is in the request.
        text: UTF-8.

    Raises:
        InvalidRequest: It is no JSON, or would take far more memory than points of its size do.
    """
    lists = text.count(b"[") + text.count(b"{")
    # Most lists are points, of 8 bytes or more. An empty one takes 3 bytes, and 64 in memory.
    if lists > len(text) // 7 + MAX_SHORT_LISTS:
        value = f"{lists} lists and objects in {len(text)} bytes"
        raise InvalidRequest(field, value, "Send lists that hold numbers.")
    collecting = gc.isenabled()
    gc.disable()  # it would look through millions of lists again and again, and find nothing
    try:
        if len(text) < LONG:
            return json.loads(text)
        # The parser in C lets no other thread run; what it calls in Python does.
        return json.loads(text, parse_float=_float, parse_int=_int)
    except (ValueError, RecursionError) as error:
        raise InvalidRequest(field, f"no valid JSON ({error})", "Send a JSON object.") from None
    finally:
        if collecting:
            gc.enable()


def _float(text: str) -> float:
    return float(text)


def _int(text: str) -> int:
    return int(text)
