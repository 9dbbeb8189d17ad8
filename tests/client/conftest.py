import asyncio
from collections.abc import Iterator
from typing import Any

import pytest

from edgegrasp_client import AsyncGraspClient, GraspClient


class FromAsync:
    """The asynchronous client behind the synchronous one's methods: one suite tests both."""

    def __init__(self, address: str, **arguments: Any) -> None:
        self._loop = asyncio.new_event_loop()
        self._client = self._run(self._make(address, arguments))

    async def _make(self, address: str, arguments: dict[str, Any]) -> AsyncGraspClient:
        return AsyncGraspClient(address, **arguments)

    def _run(self, coroutine: Any) -> Any:
        return self._loop.run_until_complete(coroutine)

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._client, name)
        return lambda *args, **kwargs: self._run(method(*args, **kwargs))

    def detect_stream(self, *args: Any, **kwargs: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [answer async for answer in self._client.detect_stream(*args, **kwargs)]

        return self._run(collect())

    def close(self) -> None:
        self._run(self._client.close())
        self._loop.close()


@pytest.fixture(params=[GraspClient, FromAsync], ids=["sync", "async"])
def make_client(request: pytest.FixtureRequest) -> Iterator[Any]:
    clients = []

    def make(address: str, **arguments: Any) -> Any:
        clients.append(request.param(address, **arguments))
        return clients[-1]

    yield make
    for client in clients:
        client.close()


@pytest.fixture(params=["grpc", "rest"])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def client(transport: str, dummy_server: Any) -> Iterator[GraspClient]:
    """For what is the same in both clients: how requests are written and answers read."""
    with GraspClient(dummy_server.address(transport)) as client:
        yield client


@pytest.fixture
def either_client(transport: str, make_client: Any, dummy_server: Any) -> Any:
    return make_client(dummy_server.address(transport))
