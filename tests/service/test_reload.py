"""New weights beside the old ones: no request is dropped, and bad weights change nothing."""

import asyncio
import re
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from tests.programs import until

from edgegrasp_client import AsyncGraspClient, GraspClient
from edgegrasp_model.detector import WEIGHTS_FOLDER

from .conftest import ADMIN, USER

NEW = "new-token-0123456789"


async def digest(running: Any) -> str:
    return (await running.ours("rest").models())[0].digest


async def test_a_reload_changes_the_digest(serve, transport: str) -> None:
    running = await serve(admin_tokens=[ADMIN])
    assert await digest(running) == "1"
    assert (await running.connect(transport).reload(ADMIN)).digest == "2"
    assert await digest(running) == "2"
    page = running.metrics()
    assert 'edgegrasp_reloads_total{outcome="succeeded"} 1.0' in page
    info = 'edgegrasp_model_info{architecture="dummy",default="true",device="cpu",digest="2"'
    assert info in page
    assert 'digest="1"' not in page


async def test_bad_weights_leave_the_old_ones(serve, transport: str, cloud: np.ndarray) -> None:
    running = await serve(admin_tokens=[ADMIN])
    admin = running.connect(transport)
    running.stages.fail("weights", "mine.safetensors: truncated")
    reply = await admin.reload(ADMIN)
    assert reply.kind == "reload-failed"
    assert "mine.safetensors: truncated" in reply.detail
    running.stages.mend("weights")
    running.stages.fail("load", "kill")  # as where there is no memory for both
    assert (await admin.reload(ADMIN)).kind == "reload-failed"
    assert await digest(running) == "1"
    assert len((await running.ours("grpc").detect(cloud)).grasps) == 10
    assert 'edgegrasp_reloads_total{outcome="failed"} 2.0' in running.metrics()
    assert (await admin.reload(ADMIN)).digest == "3"


async def test_only_an_admin_token_reloads(serve, transport: str) -> None:
    running = await serve(tokens=[USER], admin_tokens=[ADMIN])
    admin = running.connect(transport)
    kinds = [(await admin.reload(token)).kind for token in (None, USER, USER + "x", ADMIN)]
    assert kinds == ["unauthenticated", "permission-denied", "unauthenticated", ""]
    running = await serve(tokens=[USER])  # nobody may
    assert (await running.connect(transport).reload(USER)).kind == "permission-denied"


async def test_no_spelling_of_the_address_comes_around_the_token(serve) -> None:
    running = await serve(tokens=[USER], admin_tokens=[ADMIN])
    http, headers = running.http(), {"authorization": f"Bearer {USER}"}
    for tail in ("", "%0A", "/", "%2F", "?x=1", ";", "%00", "//"):
        for start in ("/v1/models:reload", "/v1/models%3Areload", "/v1/./models:reload"):
            answer = await http.post(start + tail, headers=headers, follow_redirects=True)
            assert answer.status_code in (403, 404, 405), answer.text
    assert running.stages.begun["load"] == 1


async def test_answers_keep_coming_while_weights_load(serve, transport, cloud) -> None:
    running = await serve(admin_tokens=[ADMIN])
    by_grpc, by_http = running.ours("grpc"), running.ours("rest")
    running.stages.shut("load")
    reload = asyncio.create_task(running.connect(transport).reload(ADMIN))
    for client in (by_grpc, by_http) * 5:
        assert len((await client.detect(cloud)).grasps) == 10
    assert not reload.done()

    async def ask(client: AsyncGraspClient) -> int:
        count = 0
        while not reload.done():
            assert len((await client.detect(cloud)).grasps) == 10
            count += 1
        return count

    asking = asyncio.gather(ask(by_grpc), ask(by_http), ask(by_grpc))
    running.stages.open("load")
    assert (await reload).digest == "2"
    assert sum(await asking) >= 3


async def test_one_reload_at_a_time(serve) -> None:
    running = await serve(admin_tokens=[ADMIN])
    running.stages.shut("load")
    admin = running.connect("grpc")
    reloads = [asyncio.create_task(admin.reload(ADMIN)) for _ in range(4)]
    await asyncio.wait(reloads, return_when=asyncio.FIRST_COMPLETED)
    running.stages.open("load")
    kinds = sorted([(await reload).kind for reload in reloads])
    assert kinds == ["", "reload-failed", "reload-failed", "reload-failed"]
    assert await digest(running) == "2"


async def test_what_was_begun_with_the_old_weights_ends_with_them(serve, cloud) -> None:
    running = await serve(admin_tokens=[ADMIN])
    client = running.connect("grpc")
    asked = await running.hold(client.detect(cloud), "finish")
    assert (await running.connect("rest").reload(ADMIN)).digest == "2"
    running.stages.open("finish")
    assert (await asked).fine
    assert (await client.detect(cloud)).fine


async def test_tokens_are_read_anew(serve, tmp_path: Path, transport: str) -> None:
    file = tmp_path / "tokens"
    file.write_text(USER)
    running = await serve(token_file=file, admin_tokens=[ADMIN])
    admin = running.connect(transport)
    file.write_text("short")
    reply = await admin.reload(ADMIN)
    assert reply.kind == "reload-failed"
    assert "token_file" in reply.detail
    await running.ours(transport, token=USER).models()
    file.write_text(NEW)
    assert (await admin.reload(ADMIN)).fine
    await running.ours(transport, token=NEW).models()
    with pytest.raises(Exception, match="does not know"):
        await running.ours(transport, token=USER).models()


def test_sighup_swaps_real_weights_and_survives_truncated_ones(real_server, cloud) -> None:
    """Under load: every answer is one, before, while and after weights are swapped."""
    file, stop = real_server.mine, threading.Event()
    data, other = (
        (WEIGHTS_FOLDER / f"{name}.safetensors").read_bytes()
        for name in ("edgegrasp", "edgegrasp-plus")
    )

    def load() -> int:
        with GraspClient(real_server.grpc_address, timeout=60) as client:
            count = 0
            while not stop.is_set():
                client.detect(cloud, num_approach_points=2, num_candidates=20)
                count += 1
        return count

    def reloaded_with(content: bytes) -> tuple[str, str]:
        """The outcome, and the digest afterwards."""
        new = file.with_suffix(".new")  # as whoever installs weights should
        new.write_bytes(content)
        new.replace(file)
        before = reloads(real_server)
        real_server.process.send_signal(signal.SIGHUP)
        ((outcome, _),) = until(lambda: set(reloads(real_server)) - set(before))
        with GraspClient(real_server.http_url) as client:
            digest = next(model.digest for model in client.models() if model.name == "mine")
        return outcome, digest

    with ThreadPoolExecutor() as pool:
        counted = pool.submit(load)
        try:
            bad, before = reloaded_with(data[: len(data) // 2])
            good, after = reloaded_with(other)
        finally:
            stop.set()
        assert counted.result() > 0
    assert (bad, good, before != after) == ("failed", "succeeded", True)


def reloads(server: Any) -> list[tuple[str, str]]:
    """How often each outcome was."""
    page = httpx.get(f"{server.http_url}/metrics").text
    return re.findall(r'edgegrasp_reloads_total\{outcome="(\w+)"\} (\S+)', page)
