"""What a block of a test is refused for, and how much memory it takes."""

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from edgegrasp_camera import InvalidRequest
from edgegrasp_client import InvalidRequestError

Kind = type[InvalidRequest] | type[InvalidRequestError]


@contextmanager
def refusal(field: str, value: str = "", fix: str = "", kind: Kind | None = None) -> Iterator[None]:
    """Fail unless an error names the field, with these words in its value and in its fix.

    A field that ends with a dot may also be a part of that field.
    """
    with pytest.raises(kind or (InvalidRequest, InvalidRequestError)) as caught:
        yield
    error = caught.value
    assert error.field == field or (field[-1] == "." and f"{error.field}.".startswith(field))
    assert error.value
    assert value in error.value
    assert error.fix
    assert fix in error.fix
    assert str(error) == f"{error.field}: got {error.value}. {error.fix}"


@contextmanager
def bounded_memory(allowed: float) -> Iterator[None]:
    """Fail if more bytes are held at once, beyond those held before."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak <= allowed, f"{peak} bytes at once where {allowed} are allowed"
