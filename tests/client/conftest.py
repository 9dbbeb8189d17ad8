from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from edgegrasp_client import GraspClient


@pytest.fixture
def make_client() -> Iterator[Callable[..., GraspClient]]:
    """Of the synchronous client, which runs the asynchronous one."""
    with ExitStack() as stack:
        yield lambda *args, **named: stack.enter_context(GraspClient(*args, **named))


@pytest.fixture
def client(transport: str, make_client: Any, dummy_server: Any) -> Any:
    return make_client(dummy_server.address(transport))
