"""What a robot tells of its grasps: kept where the operator wants it, and as much as fits."""

import json
import resource
import signal
from pathlib import Path

import httpx
import jsonschema
import pytest

from edgegrasp_service.errors import DiskFull, InvalidSettings
from edgegrasp_service.front.http import DOCUMENT
from edgegrasp_service.recording import append_line, check_outcomes
from edgegrasp_training.outcomes import read_outcomes

TRIED = {"model": "dummy", "score": 0.9, "held": True, "request_id": "a1"}


def test_outcomes_are_appended_until_the_file_is_full(start_dummy, tmp_path: Path) -> None:
    file = tmp_path / "outcomes.jsonl"
    with (
        start_dummy("--outcomes-file", str(file)) as server,
        httpx.Client(base_url=server.http_url) as http,
    ):
        jsonschema.validate(TRIED, DOCUMENT["components"]["schemas"]["TriedGrasp"])
        assert http.post("/v1/outcomes", json=TRIED).json() == {}
        assert http.post("/v1/outcomes", json={**TRIED, "held": False}).is_success
        first, second = map(json.loads, file.read_text().splitlines())
        digest = http.get("/v1/models").json()["models"][0]["digest"]
        assert TRIED.items() <= first.items()
        assert (first["digest"], second["held"]) == (digest, False)
        assert read_outcomes(file, digest).held.tolist() == [1.0, 0.0]

        for changes, field in (
            ({"score": 1.5}, "body.score"),
            ({"held": None}, "body.held"),
            ({"cloud": []}, "body.cloud"),
            ({"model": "resnet"}, "options.model"),
        ):
            answer = http.post("/v1/outcomes", json=TRIED | changes)
            assert answer.json()["field"] == field
        as_json = {"content-type": "application/json"}
        assert http.post("/v1/outcomes", content=b"{", headers=as_json).status_code == 400
        # A form of a web page elsewhere.
        assert http.post("/v1/outcomes", content=json.dumps(TRIED)).status_code == 415
        assert len(file.read_text().splitlines()) == 2

        with file.open("r+b") as grown:
            grown.truncate(64 * 2**20 + 1)
        full = http.post("/v1/outcomes", json=TRIED)
        assert full.status_code == 413
        assert "Move the file away" in full.json()["detail"]


def test_there_are_no_outcomes_unless_the_operator_wants_them(dummy_server) -> None:
    assert httpx.post(f"{dummy_server.http_url}/v1/outcomes", json=TRIED).status_code == 404


@pytest.mark.parametrize("body", ["[]", '{"model": "dummy"}'])
def test_files_that_hold_no_outcomes(tmp_path: Path, body: str) -> None:
    file = tmp_path / "outcomes.jsonl"
    file.write_text(body + "\n")
    with pytest.raises(ValueError, match="line 1"):
        read_outcomes(file, "abc")


def test_lines_are_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "outcomes.jsonl"
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


def test_a_file_that_cannot_be_written_is_told_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(InvalidSettings, match="No such file"):
        check_outcomes(tmp_path / "none" / "outcomes.jsonl")
