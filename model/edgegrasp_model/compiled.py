"""Where Numba is installed (the extra `fast`), loops compiled to machine code."""

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any


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
