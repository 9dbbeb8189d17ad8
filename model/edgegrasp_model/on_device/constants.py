"""Numbers that come again with every request: they go to a device once."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

KEPT = 512


def constant(
    values: Sequence[Any], device: torch.device, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Numbers, or rows of them, as a tensor that nobody may write to."""
    return _constant(tuple(_frozen(value) for value in values), device, dtype)


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, (tuple, list)) else value


@lru_cache(maxsize=KEPT)
def _constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.tensor(values, dtype=dtype, device=device)
