"""Long JSON holds up neither the event loop nor the threads beside it."""

import asyncio
import json
import sys
import threading
import weakref
from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.results import Detection
from edgegrasp_service import http_request, json_text
from edgegrasp_service.call import Call
from edgegrasp_service.core import DetectRequest
from edgegrasp_service.json_text import LONG, read_json
from edgegrasp_service.sent_arrays import BLOCK, numbers_from_lists
from edgegrasp_service.sent_cloud import ListCloud, SentCloud

ROWS = [[0.25, 0.5, 1.0]] * (2 * BLOCK + 7)


async def test_the_server_answers_while_json_is_read(serve, cloud, monkeypatch) -> None:
    running = await serve()
    begun, go_on = asyncio.Event(), threading.Event()
    threads: list[str] = []
    loop = asyncio.get_running_loop()

    def held(field: str, text: bytes) -> object:
        threads.append(threading.current_thread().name)
        loop.call_soon_threadsafe(begun.set)
        assert go_on.wait(20)
        return read_json(field, text)

    monkeypatch.setattr(http_request, "read_json", held)
    async with httpx.AsyncClient(base_url=running.server.http_url, timeout=20) as http:
        asked = asyncio.create_task(http.post("/v1/grasps", json={"points": cloud.tolist()}))
        await asyncio.wait_for(begun.wait(), 20)
        assert (await http.get("/health/live")).status_code == 200
        assert not asked.done()
        go_on.set()
        assert (await asked).status_code == 200
    assert threads[0] == "companion" or threads[0].startswith("decode")


async def test_nothing_is_read_of_a_request_that_waits(serve, cloud, monkeypatch) -> None:
    """What a text says takes many times its bytes: only those at work have that."""
    running = await serve(max_concurrent_requests=1)
    running.stages.shut("run")
    read: list[str] = []

    def noted(field: str, text: bytes) -> object:
        read.append(field)
        return read_json(field, text)

    monkeypatch.setattr(http_request, "read_json", noted)
    async with httpx.AsyncClient(base_url=running.server.http_url, timeout=20) as http:
        body = {"points": cloud.tolist()}
        asked = [asyncio.create_task(http.post("/v1/grasps", json=body)) for _ in range(3)]
        await running.until(lambda: running.told.waiting == 2 and running.stages.begun["run"] == 1)
        assert len(read) == 1
        running.stages.open("run")
        assert [response.status_code for response in await asyncio.gather(*asked)] == [200] * 3


async def test_what_was_read_is_let_go_once_it_is_decoded(serve, cloud) -> None:
    running = await serve()
    running.stages.shut("run")
    kept: list[weakref.ref[ListCloud]] = []

    def read() -> DetectRequest:
        source = ListCloud(cloud.tolist())
        kept.append(weakref.ref(source))
        return DetectRequest(SentCloud(source))

    async def ask() -> Detection:
        with running.service.admit(Call("http", "DetectGrasps")) as place:
            return await running.service.detect(read, place)

    asked = asyncio.create_task(ask())
    await running.until(lambda: running.stages.begun["run"] == 1)
    assert [each() for each in kept] == [None]
    running.stages.open("run")
    assert (await asked).grasps


@pytest.fixture
def turns() -> Iterator[list[int]]:
    """Its one number grows whenever another thread may run."""
    counted, over = [0], threading.Event()

    def count() -> None:
        while not over.is_set():
            counted[0] += 1

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    thread = threading.Thread(target=count)
    thread.start()
    yield counted
    over.set()
    thread.join()
    sys.setswitchinterval(interval)


@pytest.mark.parametrize(("name", "number"), [("_float", 0.5), ("_int", 7)])
def test_others_run_while_a_long_text_is_read(monkeypatch, turns, name, number) -> None:
    """The parser itself lets no one; what it calls for each number does."""
    value = [[number] * 3] * 40_000
    text = json.dumps(value).encode()
    assert len(text) > LONG
    seen: list[int] = []
    made = getattr(json_text, name)

    def noted(word: str) -> float:
        seen.append(turns[0])
        return made(word)

    monkeypatch.setattr(json_text, name, noted)
    assert read_json("body", text) == value
    assert len(seen) == 120_000
    assert seen[-1] > seen[0]


def test_rows_of_several_blocks_are_one_array() -> None:
    array = numbers_from_lists("points", ROWS)
    np.testing.assert_array_equal(array, ROWS)
    assert array.dtype == np.float64
    whole = numbers_from_lists("segment_ids", list(range(2 * BLOCK)))
    assert (whole.shape, whole.dtype) == ((2 * BLOCK,), np.int64)
    assert numbers_from_lists("points", [[1, 2, 3]] * BLOCK + [[0.5, 0, 0]]).dtype == np.float64


@pytest.mark.parametrize(
    ("last", "value"),
    [
        ([1.0, 2.0], "rows of different lengths"),
        (3.0, "rows of different lengths"),
        (["a", 1.0, 2.0], "['a', 1.0, 2.0]"),
        ([None, 1.0, 2.0], "[None, 1.0, 2.0]"),
    ],
)
def test_what_is_wrong_in_a_later_block_is_found(last: object, value: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        numbers_from_lists("points", [*ROWS, last])
    assert (caught.value.field, caught.value.value) == ("points", value)
