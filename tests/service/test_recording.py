"""Requests and answers in a folder, and the same answer when one is replayed."""

import asyncio
import json
import resource
import signal
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import numpy as np
import pytest
from benchmarks.dummy import DummyCatalogue
from tests.cloud_files import npy

from edgegrasp_client import GraspClient, InvalidRequestError
from edgegrasp_lab.replay import answer_again
from edgegrasp_service.errors import DiskFull, InvalidSettings
from edgegrasp_service.front.http import OPENAPI_DOCUMENT
from edgegrasp_service.front.service import Admission
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import answer
from edgegrasp_service.worker.process import MESSAGE_HEADER, Answer, Facts, Job, pack
from edgegrasp_service.worker.recording import Recorder, append_line, check_outcomes
from edgegrasp_training.evaluation import read_outcomes


async def test_recorded_requests_are_replayed(serve, transport, cloud, tmp_path, monkeypatch):
    running = await serve(record_folder=tmp_path / "recorded")
    client = running.connect(transport)
    assert (await client.detect(cloud, seed=3)).fine
    assert not (await client.detect(cloud[:0])).fine
    running.stages.fail("evaluate", "crash")
    await client.detect(cloud)
    running.stop.set()
    await running.serving
    fine, bad, harmful = sorted((tmp_path / "recorded").glob("*.job"))
    settings = Settings()
    monkeypatch.setattr(answer, "load_catalogue", lambda settings: DummyCatalogue())
    _, recorded, again = answer_again(fine, settings)
    assert again.error is None
    assert again.facts.grasps == 10
    assert len(again.body) > 1000
    if transport == "rest":  # a map of protobuf has no order
        cut = recorded.body.index(b'"seconds"')
        assert again.body[:cut] == recorded.body[:cut]
    assert answer_again(bad, settings)[-1].error.kind == "invalid-request"
    assert answer_again(harmful, settings)[1].error.kind == "harmful-request"
    tried = Job("RecordOutcome", "http", b""), Answer(b"{}", Facts())  # it would be kept twice
    outcome = b"".join(part for message in tried for part in pack(message))
    deep = MESSAGE_HEADER.pack(200_000, 0) + b"[" * 200_000
    short = fine.read_bytes()[:-9000], bad.read_bytes()[12:]
    for other in (b"", deep, b"\xff" * 64, *short, outcome):
        fine.write_bytes(other)
        with pytest.raises(ValueError, match="is not a recorded request"):
            answer_again(fine, settings)


async def test_the_oldest_are_deleted_with_those_of_earlier_runs(serve, cloud, tmp_path) -> None:
    for number in range(3):
        (tmp_path / f"20200101T00000{number}000000Z-old.job").write_bytes(bytes(500_000))
    (tmp_path / "notes.txt").write_text("mine")
    running = await serve(record_folder=tmp_path, record_bytes=2**20)
    body = npy(np.tile(cloud, (60, 1)))  # 360 kB
    http, headers = running.http(), {"content-type": "application/x-npy"}
    for number in range(5):
        headers["x-request-id"] = f"r{number}"
        await http.post("/v1/grasps", content=body, headers=headers)
    headers["x-request-id"] = "large"  # not worth all others
    await http.post("/v1/grasps", content=npy(np.tile(cloud, (240, 1))), headers=headers)
    running.stop.set()
    await running.serving
    assert [path.stem[-2:] for path in sorted(tmp_path.glob("*.job"))] == ["r3", "r4"]
    assert (tmp_path / "notes.txt").exists()
    assert running.server.service.admission.held_bytes == 0


async def test_what_waits_to_be_written_is_bounded(tmp_path: Path) -> None:
    with pytest.raises(InvalidSettings, match="record_folder"):
        Recorder(tmp_path / "none" / "recorded", 2**20, lambda size: True)
    with pytest.raises(InvalidSettings, match="No such file"):
        check_outcomes(tmp_path / "none" / "outcomes.jsonl")
    assert not (tmp_path / "none").exists()
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


TRIED = {"model": "dummy", "score": 0.9, "held": True, "request_id": "a1"}


def test_outcomes_are_appended_until_the_file_is_full(start_dummy, cloud, tmp_path) -> None:
    file = tmp_path / "outcomes.jsonl"
    with (
        start_dummy("--outcomes-file", str(file)) as server,
        httpx.Client(base_url=server.http_url) as http,
    ):
        jsonschema.validate(TRIED, OPENAPI_DOCUMENT["components"]["schemas"]["TriedGrasp"])
        assert http.post("/v1/outcomes", json=TRIED).json() == {}
        assert http.post("/v1/outcomes", json={**TRIED, "held": False}).is_success
        first, second = map(json.loads, file.read_text().splitlines())
        digest = http.get("/v1/models").json()["models"][0]["digest"]
        assert TRIED.items() <= first.items()
        assert (first["digest"], second["held"]) == (digest, False)
        with GraspClient(server.http_url) as client:
            detection = client.detect(cloud)
            client.record_outcome(detection, detection.grasps[0], held=True)
            unclear: Any = "maybe"
            with pytest.raises(InvalidRequestError, match="held: got 'maybe'"):
                client.record_outcome(detection, detection.grasps[0], held=unclear)
        assert read_outcomes(file, digest)[1].tolist() == [1.0, 0.0, 1.0]

        for changes, field in (
            ({"score": 1.5}, "body.score"),
            ({"held": None}, "body.held"),
            ({"held": "no"}, "body.held"),
            ({"score": True}, "body.score"),
            ({"cloud": []}, "body.cloud"),
            ({"model": "resnet"}, "options.model"),
        ):
            assert http.post("/v1/outcomes", json=TRIED | changes).json()["field"] == field
        as_json = {"content-type": "application/json"}
        assert http.post("/v1/outcomes", content=b"{", headers=as_json).status_code == 400
        # A form of a web page elsewhere.
        assert http.post("/v1/outcomes", content=json.dumps(TRIED)).status_code == 415
        assert len(file.read_text().splitlines()) == 3

        with file.open("r+b") as grown:
            grown.truncate(64 * 2**20 + 1)
        full = http.post("/v1/outcomes", json=TRIED)
        assert full.status_code == 413
        assert "Move the file away" in full.json()["detail"]


def test_there_are_no_outcomes_unless_the_operator_wants_them(dummy_server) -> None:
    refused = httpx.post(f"{dummy_server.http_url}/v1/outcomes", json=TRIED)
    assert refused.status_code == 400
    assert "outcomes_file" in refused.json()["fix"]


def test_lines_are_whole_or_not_there(tmp_path: Path) -> None:
    file = tmp_path / "outcomes.jsonl"
    for body in ("[]", '{"model": "dummy"}'):  # no outcomes
        file.write_text(body + "\n")
        with pytest.raises(ValueError, match="line 1"):
            read_outcomes(file, "abc")
    file.write_bytes(b'{"a": 1}')  # an editor left out the newline
    check_outcomes(file)
    assert file.read_bytes() == b'{"a": 1}'
    append_line(file, b'{"b": 2}\n')
    assert file.read_bytes() == b'{"a": 1}\n{"b": 2}\n'
    file.write_bytes(b'{"a": 1}\n{"half')
    append_line(file, b'{"b": 2}\n')
    assert file.read_bytes() == b'{"a": 1}\n{"b": 2}\n'
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (25, hard))  # the disk is full within a line
    try:
        with pytest.raises(DiskFull):
            append_line(file, b'{"c": 333333}\n')
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert file.read_bytes() == b'{"a": 1}\n{"b": 2}\n'
