"""New weights beside the old ones: no request is dropped, and bad weights change nothing."""

import asyncio
import signal
import threading
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import AsyncGraspClient, GraspClient
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_service.core import GraspService
from edgegrasp_service.dummy import DummyCatalogue
from edgegrasp_service.settings import Settings

USER = "user-token-0123456789"
ADMIN = "admin-token-0123456789"
NEW = "new-token-0123456789"


class Shelf:
    """Weights that change: each load gives the next digest, once it may."""

    def __init__(self) -> None:
        self.loads = 0
        self.may_load = threading.Event()
        self.may_load.set()
        self.error: Exception | None = None

    def load(self) -> DummyCatalogue:
        assert self.may_load.wait(20)
        if self.error is not None:
            raise self.error
        self.loads += 1
        return Numbered(str(self.loads))


class Numbered(DummyCatalogue):
    def __init__(self, digest: str) -> None:
        super().__init__(0.002)
        self.digest = digest

    def describe(self) -> Any:
        return [{**super().describe()[0], "digest": self.digest}]


@pytest.fixture
def shelf() -> Shelf:
    return Shelf()


@pytest.fixture
def service(shelf: Shelf) -> GraspService:
    return GraspService(shelf.load, Settings())


class Admin:
    """Asks one transport for a reload; the same answers from both."""

    def __init__(self, server: Any, transport: str) -> None:
        self._server, self._transport = server, transport

    async def reload(self, token: str | None = ADMIN) -> tuple[str, str]:
        """The digest, or the kind of error; and the detail."""
        headers = {"authorization": f"Bearer {token}"} if token else {}
        if self._transport == "rest":
            async with httpx.AsyncClient(base_url=self._server.http_url, timeout=20) as http:
                answer = await http.post("/v1/models:reload", headers=headers)
            body = answer.json()
            if answer.is_success:
                return body["models"][0]["digest"], ""
            return body["type"].removeprefix("urn:edgegrasp:error:"), body["detail"]
        async with aio.insecure_channel(self._server.grpc_address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            try:
                request = grasp_pb2.ReloadModelsRequest()
                answer = await stub.ReloadModels(request, metadata=tuple(headers.items()))
            except aio.AioRpcError as error:
                trailers = dict(error.trailing_metadata())
                detail = grasp_pb2.ErrorDetail.FromString(trailers["edgegrasp-error-bin"])
                return detail.kind, error.details() or ""
            return answer.models[0].digest, ""


@pytest.fixture(params=["grpc", "rest"])
def transport(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


async def digest(server: Any) -> str:
    async with AsyncGraspClient(server.http_url) as client:
        return (await client.models())[0].digest


async def test_a_reload_changes_the_digest(serving, service, transport: str) -> None:
    async with serving(service, admin_tokens=[ADMIN]) as server:
        assert await digest(server) == "1"
        assert await Admin(server, transport).reload() == ("2", "")
        assert await digest(server) == "2"
        page, _ = server.metrics.page("")
        assert b'edgegrasp_reloads_total{outcome="succeeded"} 1.0' in page
        assert (
            b'edgegrasp_model_info{architecture="dummy",default="true",device="cpu",digest="2"'
            in page
        )
        assert b'digest="1"' not in page


async def test_bad_weights_leave_the_old_ones(
    serving, service, shelf: Shelf, transport: str, cloud: np.ndarray
) -> None:
    async with serving(service, admin_tokens=[ADMIN]) as server:
        for error, said in (
            (InvalidCheckpoint("mine.safetensors: truncated"), "mine.safetensors: truncated"),
            (MemoryError("secret"), "the log says why"),
        ):
            shelf.error = error
            kind, detail = await Admin(server, transport).reload()
            assert (kind, said in detail) == ("reload-failed", True)
            assert "secret" not in detail
            assert await digest(server) == "1"
        async with AsyncGraspClient(server.grpc_address) as client:
            assert len((await client.detect(cloud)).grasps) == 10
        page, _ = server.metrics.page("")
        assert b'edgegrasp_reloads_total{outcome="failed"} 2.0' in page
        shelf.error = None
        assert await Admin(server, transport).reload() == ("2", "")


async def test_only_an_admin_token_reloads(serving, service, transport: str) -> None:
    async with serving(service, tokens=[USER], admin_tokens=[ADMIN]) as server:
        admin = Admin(server, transport)
        kinds = [(await admin.reload(token))[0] for token in (None, USER, USER + "x", ADMIN)]
        assert kinds == ["unauthenticated", "permission-denied", "unauthenticated", "2"]


SPELLINGS = ["%0A", "/", "%2F", "?x=1", ";", "%00", "#", "%0A%0A", "//"]


@pytest.mark.parametrize("tail", SPELLINGS)
async def test_no_spelling_of_the_address_comes_around_the_token(
    serving, service, shelf: Shelf, tail: str
) -> None:
    async with serving(service, tokens=[USER], admin_tokens=[ADMIN]) as server:
        headers = {"authorization": f"Bearer {USER}"}
        async with httpx.AsyncClient(base_url=server.http_url, headers=headers) as http:
            for start in ("/v1/models:reload", "/v1/models%3Areload", "/v1/./models:reload"):
                answer = await http.post(start + tail, follow_redirects=True)
                assert answer.status_code in (403, 404, 405), answer.text
    assert shelf.loads == 1


async def test_without_admin_tokens_nobody_reloads(serving, service, shelf, transport: str) -> None:
    async with serving(service, tokens=[USER]) as server:
        for token in (None, USER):
            kind, detail = await Admin(server, transport).reload(token)
            assert (kind, "SIGHUP" in detail) == ("permission-denied", True)
        async with httpx.AsyncClient(base_url=server.http_url) as http:
            assert (await http.post("/v1/models:reload%0A")).status_code in (401, 403)
    assert shelf.loads == 1


async def test_answers_keep_coming_while_weights_load(
    serving, service, shelf: Shelf, transport: str, cloud: np.ndarray
) -> None:
    async with (
        serving(service, admin_tokens=[ADMIN]) as server,
        AsyncGraspClient(server.grpc_address) as by_grpc,
        AsyncGraspClient(server.http_url) as by_http,
    ):
        shelf.may_load.clear()
        reload = asyncio.create_task(Admin(server, transport).reload())
        answers = 0
        for client in (by_grpc, by_http) * 10:
            answers += len((await client.detect(cloud)).grasps) == 10
        assert not reload.done()
        assert answers == 20

        async def ask(client: AsyncGraspClient) -> int:
            count = 0
            while not reload.done():
                assert len((await client.detect(cloud)).grasps) == 10
                count += 1
            return count

        asking = asyncio.gather(ask(by_grpc), ask(by_http), ask(by_grpc))
        shelf.may_load.set()
        assert (await reload)[0] == "2"
        assert sum(await asking) >= 3


async def test_reloads_take_turns_and_none_piles_up(serving, service, shelf: Shelf) -> None:
    async with serving(service, admin_tokens=[ADMIN]) as server:
        shelf.may_load.clear()
        reloads = [asyncio.create_task(Admin(server, "grpc").reload()) for _ in range(4)]
        await asyncio.wait(reloads, return_when=asyncio.FIRST_COMPLETED)
        shelf.may_load.set()
        kinds = sorted([(await reload)[0] for reload in reloads])
        assert kinds == ["2", "3", "reload-failed", "reload-failed"]
        assert await digest(server) == "3"


async def test_tokens_are_read_anew(serving, service, tmp_path: Path, transport: str) -> None:
    file = tmp_path / "tokens"
    file.write_text(USER)
    async with serving(service, token_file=file, admin_tokens=[ADMIN]) as server:
        file.write_text("short")
        kind, detail = await Admin(server, transport).reload()
        assert (kind, "token_file" in detail) == ("reload-failed", True)
        address = server.grpc_address if transport == "grpc" else server.http_url
        async with AsyncGraspClient(address, token=USER) as client:
            await client.models()
        file.write_text(NEW)
        assert (await Admin(server, transport).reload())[1] == ""
        async with AsyncGraspClient(address, token=NEW) as client:
            await client.models()
        async with AsyncGraspClient(address, token=USER) as client:
            with pytest.raises(Exception, match="does not know"):
                await client.models()


def test_sighup_swaps_real_weights_and_survives_truncated_ones(
    start_server, tmp_path: Path, cloud: np.ndarray
) -> None:
    """Under load: every answer is one, before, while and after weights are swapped."""
    shipped = next(WEIGHTS_FOLDER.glob("*.safetensors"), None)
    if shipped is None:
        pytest.skip("no weights ship")
    data = bytearray(shipped.read_bytes())
    file = tmp_path / "mine.safetensors"
    file.write_bytes(data)
    with start_server("--weights", str(file), "--default-model", "mine") as server:

        def mine() -> str:
            with GraspClient(server.http_url) as client:
                return next(model.digest for model in client.models() if model.name == "mine")

        before = mine()
        stop, counts, faults = threading.Event(), [0], []

        def load() -> None:
            with GraspClient(server.grpc_address, timeout=60) as client:
                while not stop.is_set():
                    try:
                        client.detect(cloud, num_approach_points=2, num_candidates=20)
                        counts[0] += 1
                    except Exception as error:
                        faults.append(error)

        thread = threading.Thread(target=load)
        thread.start()
        try:
            data[-4] ^= 1  # the last bit of a parameter
            replace(file, data[: len(data) // 2])
            server.process.send_signal(signal.SIGHUP)
            outcome(server, "failed")
            assert mine() == before
            replace(file, data)
            server.process.send_signal(signal.SIGHUP)
            outcome(server, "succeeded")
            assert mine() != before
        finally:
            stop.set()
            thread.join()
        assert faults == []
        assert counts[0] > 0
        assert server.stop() == 0


def replace(file: Path, data: bytes | bytearray) -> None:
    """As whoever installs weights should: the file is whole, or the old one."""
    new = file.with_suffix(".new")
    new.write_bytes(data)
    new.replace(file)


def outcome(server: Any, word: str) -> None:
    """Return once a reload ended this way."""
    with httpx.Client(base_url=server.http_url) as http:
        for _ in range(600):
            if f'edgegrasp_reloads_total{{outcome="{word}"}} 1.0' in http.get("/metrics").text:
                return
            threading.Event().wait(0.1)
    raise AssertionError(f"no reload {word} within a minute")
