"""Requests and answers in a folder, and the same answer when one is replayed."""

import asyncio
import os
from pathlib import Path

import httpx
import numpy as np
import pytest
from benchmarks.dummy import DummyCatalogue
from tests.cloud_files import npy

from edgegrasp_cli.replay import answer_again
from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.front.admission import Admission
from edgegrasp_service.recording import Recorder
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import answer
from edgegrasp_service.worker.process import Answer, Facts, Job


async def test_recorded_requests_are_replayed(serve, transport, cloud, tmp_path, monkeypatch):
    running = await serve(record_folder=tmp_path / "recorded")
    client = running.connect(transport)
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


async def test_what_is_there_already_counts_and_is_looked_at_once(serve, cloud, tmp_path) -> None:
    for number in range(3):
        (tmp_path / f"20200101T00000{number}000000Z-old.job").write_bytes(bytes(500_000))
    (tmp_path / "notes.txt").write_text("mine")
    running = await serve(record_folder=tmp_path, record_bytes=2**20)
    client = running.connect("rest")
    assert (await client.detect(cloud)).fine
    running.stop.set()
    await running.serving
    kept = sorted(path.name for path in tmp_path.glob("*.job"))
    assert [name[:4] for name in kept[:-1]] == ["2020"] * (len(kept) - 1)
    assert sum(path.stat().st_size for path in tmp_path.glob("*.job")) <= 2**20
    assert (tmp_path / "notes.txt").exists()
    assert running.server.service.admission.held_bytes == 0


async def test_how_many_files_lie_there_costs_nothing_later(tmp_path, monkeypatch) -> None:
    for number in range(2_000):
        os.mknod(tmp_path / f"20200101T000000{number:06}Z-old.job")
    recorder = Recorder(tmp_path, 2**20, lambda size: True)
    for looks in ("scandir", "listdir"):
        monkeypatch.setattr(os, looks, lambda *path: pytest.fail("the folder was read again"))
    for _ in range(3):
        recorder.record(Job("DetectGrasps", "http", bytes(600), 1.0), Answer(b"", Facts()))
    recorder.close()
    monkeypatch.undo()
    assert len([*tmp_path.glob("*.job")]) == 2_003


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    with pytest.raises(InvalidSettings, match="record_folder"):
        Recorder(tmp_path / "none" / "recorded", 2**20, lambda size: True)
    assert not (tmp_path / "none").exists()


async def test_what_waits_to_be_written_is_bounded(tmp_path: Path) -> None:
    admission = Admission(1, 1, 1000)
    recorder = Recorder(tmp_path, 2**20, admission.hold)
    job, answer_ = Job("DetectGrasps", "http", bytes(600), 1.0), Answer(b"", Facts())
    recorder.record(job, answer_)
    recorder.record(job, answer_)  # no room, before the first is written
    assert admission.held_bytes == 600
    recorder.close()
    await asyncio.sleep(0)
    while admission.held_bytes:
        await asyncio.sleep(0.01)
    assert len([*tmp_path.glob("*.job")]) == 1
