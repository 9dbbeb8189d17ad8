"""One stream of clouds, over either transport, synchronous or not."""

import itertools
from collections.abc import AsyncIterator, Iterator

import pytest

from edgegrasp_client import AsyncGraspClient, GraspClient, InvalidRequestError, StreamRequest


def test_answers_are_those_of_single_requests(client, cloud) -> None:
    requests = [StreamRequest(cloud, seed=seed, top_k=3) for seed in range(6)]
    answers = list(client.detect_stream(requests))
    assert len(answers) == 6
    for seed, answer in enumerate(answers):
        assert answer.request_id == str(seed)
        alone = client.detect(cloud, seed=seed, top_k=3)
        found = answer.result()
        assert [grasp.score for grasp in found.grasps] == [grasp.score for grasp in alone.grasps]
        assert found.counts == alone.counts


def test_what_cannot_be_sent_ends_the_stream_after_what_went_before(client, cloud) -> None:
    requests = [StreamRequest(cloud), StreamRequest("nowhere.ply"), StreamRequest(cloud)]
    with pytest.raises(InvalidRequestError, match="nowhere"):
        list(client.detect_stream(requests))
    with pytest.raises(InvalidRequestError, match="Give a cloud"):
        StreamRequest()


def test_requests_are_read_as_they_are_sent(dummy_server, cloud) -> None:
    """A controller's clouds have no end; leaving the answers ends the stream."""
    taken: list[int] = []

    def clouds() -> Iterator[StreamRequest]:
        for number in itertools.count():
            taken.append(number)
            yield StreamRequest(cloud)

    for address in (dummy_server.grpc_address, dummy_server.http_url):
        taken.clear()
        with GraspClient(address) as client:
            answers = client.detect_stream(clouds())
            assert [next(answers).request_id for _ in range(5)] == list("01234")
            answers.close()
            assert len(taken) >= 5


async def test_an_asynchronous_source(dummy_server, cloud, transport: str) -> None:
    async def clouds() -> AsyncIterator[StreamRequest]:
        for number in range(4):
            yield StreamRequest(cloud, request_id=f"cloud {number}")

    async with AsyncGraspClient(dummy_server.address(transport)) as client:
        found = [answer.request_id async for answer in client.detect_stream(clouds())]
    assert found == [f"cloud {number}" for number in range(4)]
