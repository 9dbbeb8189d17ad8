"""Requests and answers in a folder, and the same answer when one is replayed."""

import io
from pathlib import Path

import httpx
import numpy as np
import pytest
from benchmarks.dummy import DummyCatalogue

from edgegrasp_cli.replay import answer_again
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import answer


def npy(cloud: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, cloud)
    return stream.getvalue()


async def test_recorded_requests_are_replayed(
    serve, connect, cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = await serve(record_folder=tmp_path / "recorded")
    client = connect(running)
    assert (await client.detect(cloud, seed=3)).fine
    assert not (await client.detect(cloud[:0])).fine
    running.stop.set()
    await running.serving
    fine, bad = sorted((tmp_path / "recorded").glob("*.job"))
    settings = Settings()
    monkeypatch.setattr(answer, "load_catalogue", lambda settings: DummyCatalogue())
    _, recorded, again = answer_again(fine, settings)
    assert again.error is None
    assert again.facts.grasps == 10
    assert len(again.body) > 1000
    if client.name == "rest":  # a map of protobuf has no order
        cut = recorded.body.index(b'"seconds"')
        assert again.body[:cut] == recorded.body[:cut]
    assert answer_again(bad, settings)[-1].error.kind == "invalid-request"


async def test_the_oldest_are_deleted(serve, cloud, tmp_path: Path) -> None:
    running = await serve(record_folder=tmp_path / "recorded", record_bytes=2**20)
    body = npy(np.tile(cloud, (60, 1)))  # 360 kB
    headers = {"content-type": "application/x-npy"}
    async with httpx.AsyncClient(base_url=running.server.http_url, headers=headers) as http:
        for number in range(5):
            await http.post("/v1/grasps", content=body, headers={"x-request-id": f"r{number}"})
    running.stop.set()
    await running.serving
    kept = sorted((tmp_path / "recorded").glob("*.job"))
    assert [path.stem[-2:] for path in kept] == ["r3", "r4"]
    assert sum(path.stat().st_size for path in (tmp_path / "recorded").iterdir()) <= 2**20
