"""Where Numba is installed (the extra `fast`), loops compiled to machine code."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from torch import Tensor

from edgegrasp_model.products import float32_inference


def compiled(*freedom: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function when it is first called, and keep it on disk where that is possible.

    Args:
        freedom: What the compiler may change in float arithmetic, LLVM's fast-math flags.
    """
    import numba

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": set(freedom)}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            kept: Callable[..., Any] = numba.njit(cache=True, **options)(function)
            return kept
        except RuntimeError:  # no folder to keep it in: neither beside the file nor the user's own
            fresh: Callable[..., Any] = numba.njit(**options)(function)
            return fresh

    return decorate


def point_kernels() -> ModuleType | None:
    """The module of loops over points; None where Numba is absent."""
    if find_spec("numba") is None:
        return None
    return import_module("edgegrasp_model.point_kernels")


def fused(module: str, values: Tensor) -> ModuleType | None:
    """A module of fused layers where it serves: in inference in float32 on a processor, with Numba.

    Args:
        module: `edge_fused` or `vn_fused`.
        values: What the layer is to be used on.
    """
    if not float32_inference(values) or find_spec("numba") is None:
        return None
    return import_module(f"edgegrasp_model.{module}")
