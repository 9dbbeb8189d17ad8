"""Number types of matrix products."""

from contextlib import AbstractContextManager, nullcontext
from typing import Literal

import torch

Precision = Literal["float32", "float16", "bfloat16"]


def half_type(precision: Precision) -> torch.dtype | None:
    """The type of a half precision; None for the single one."""
    return {"float32": None, "float16": torch.float16, "bfloat16": torch.bfloat16}[precision]


def products_in(half: torch.dtype | None, device: torch.device) -> AbstractContextManager[object]:
    """Within it, matrix products on a device have a half precision; None: their own."""
    if half is None:
        return nullcontext()
    # The cache of weights would outlive a graph's capture, and what it holds with it.
    return torch.autocast(device.type, half, cache_enabled=False)
