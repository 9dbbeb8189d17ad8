import json
from pathlib import Path

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from edgegrasp_cli import main


@pytest.fixture
def file(cloud: np.ndarray, tmp_path: Path) -> str:
    np.save(tmp_path / "cloud.npy", cloud)
    return str(tmp_path / "cloud.npy")


def run(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(main.app, words)
    return result.exit_code, result.output


@pytest.mark.parametrize("transport", ["grpc", "rest"])
def test_json_is_that_of_the_http_api(transport: str, file: str, dummy_server) -> None:
    code, output = run("detect", file, "--server", dummy_server.address(transport), "--json")
    assert code == 0
    answer = httpx.post(
        f"{dummy_server.http_url}/v1/grasps",
        content=Path(file).read_bytes(),
        headers={"content-type": "application/x-npy"},
    ).json()
    document = json.loads(output)
    assert list(document) == list(answer)
    assert document["grasps"] == answer["grasps"]
    assert document["counts"] == answer["counts"]


def test_every_option(file: str, dummy_server) -> None:
    options = (
        "--model dummy --num-approach-points 12 --num-candidates 9 --sampling uniform --seed 4 "
        "--viewpoint 0 0 -0.5 --up 0 0 1 --support 0 0 1 -0.1 --workspace -1 -1 -1 1 1 1 "
        "--collision ignore --min-score 0.1 --top-k 2 --suppression 0 0 --timeout 20"
    )
    server = ("--server", dummy_server.grpc_address)
    code, output = run("detect", file, *server, "--json", *options.split())
    assert code == 0
    document = json.loads(output)
    assert len(document["grasps"]) == 2
    assert document["counts"]["scored"] == 12


def test_table(file: str, dummy_server) -> None:
    code, output = run("detect", file, "--server", dummy_server.http_url, "--top-k", "3")
    assert code == 0
    assert "500 points" in output
    assert "Warning: The dummy detector made these grasps up." in output


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "-1"], "options.seed: got -1."),
        (["--model", "resnet"], "options.model: got 'resnet'. Use one of: dummy."),
        (["--workspace", "1", "0", "0", "0", "1", "1"], "options.workspace: got"),
    ],
)
def test_bad_options(options: list[str], sentence: str, file: str, dummy_server) -> None:
    code, output = run("detect", file, "--server", dummy_server.grpc_address, *options)
    assert code == 1
    assert sentence in output


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("absent.npy", None, "No such file"),
        ("cloud.xyz", b"0 0 0", "Send one of: npy, npz, ply, pcd."),
        ("cloud.npy", b"foreign", "cloud: got 7 bytes that are no .npy file."),
    ],
)
def test_bad_files_without_a_server(
    name: str, content: bytes | None, sentence: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    code, output = run("detect", str(tmp_path / name))
    assert code == 1
    assert sentence in output


def test_bad_option_without_a_server(file: str) -> None:
    assert run("detect", file, "--top-k", "0")[0] == 1


def test_models(dummy_server) -> None:
    for address in (dummy_server.grpc_address, dummy_server.http_url):
        code, output = run("models", "--server", address)
        assert code == 0
        assert "dummy" in output
    code, output = run("models", "--server", "127.0.0.1:1")
    assert code == 1
    assert "edgegrasp models: " in output
