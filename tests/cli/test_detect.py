import json
from pathlib import Path

import httpx
import numpy as np
import pytest
import trustme
from typer.testing import CliRunner

from edgegrasp_cli import main
from edgegrasp_model.options import DetectOptions


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
    flags = (
        "--model dummy --gripper panda --num-approach-points 12 --num-candidates 9 "
        "--sampling uniform --seed 4 --viewpoint -0.1,0,-0.5 --up 0,0,1 "
        '--support {"kind":"ransac","distance":0.01} '
        '--workspace {"min":[-1,-1,-1],"max":[1,1,1]} '
        '--approach-region {"exclude":[{"kind":"indices","indices":[1,2]}]} '
        '--contact-region {"include":[{"kind":"sphere","center":[0,0,0],"radius":1}]} '
        '--approach-direction {"preset":"side"} --collision {"margin":0.001} '
        "--min-score 0.1 --top-k 2 --suppression null --order highest --debug --timeout 20"
    )
    given = {word[2:].replace("-", "_") for word in flags.split() if word.startswith("--")}
    assert given - {"timeout"} == set(DetectOptions.model_fields)
    for address in (dummy_server.grpc_address, dummy_server.http_url):
        code, output = run("detect", file, "--server", address, "--json", *flags.split())
        assert code == 0
        document = json.loads(output)
        assert len(document["grasps"]) == 2
        assert document["counts"]["scored"] == 12
        assert len(document["debug"]["outcome"]) == len(document["debug"]["score"]) == 12
        assert document["debug"]["score"][-1] is None


def test_options_file(file: str, dummy_server, tmp_path: Path) -> None:
    options = tmp_path / "options.json"
    options.write_text(json.dumps({"top_k": 4, "seed": 3, "collision": {"mode": "penalise"}}))
    server = ("--server", dummy_server.grpc_address, "--json", "--options", str(options))
    assert len(json.loads(run("detect", file, *server)[1])["grasps"]) == 4
    code, output = run("detect", file, *server, "--top-k", "2")
    assert (code, len(json.loads(output)["grasps"])) == (0, 2)
    for text, sentence in (("[]", "a JSON object is needed"), ("{", "Expecting property name")):
        options.write_text(text)
        code, output = run("detect", file, *server)
        assert code == 1
        assert sentence in output


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
        (
            ["--workspace", '{"min":[1,0,0],"max":[0,1,1]}'],
            "options.workspace: got",
        ),
        (["--up", "0,0"], "options.up: got [0.0, 0.0]. Give three numbers: x, y, z."),
        (["--collision", "dodge"], "options.collision.mode: got 'dodge'."),
        (
            ["--approach-region", '{"include":[{"kind":"cube"}]}'],
            "options.approach_region.include.0: got 'cube'. Set its kind to one of box,",
        ),
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
        ("cloud.las", b"0 0 0", "Send one of: npy, npz, ply, pcd, xyz."),
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


@pytest.fixture
def pem(tmp_path: Path) -> dict[str, str]:
    """Files: a CA, and a certificate of it for this machine."""
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(tmp_path / "own.pem")
    return {name: str(tmp_path / f"{name}.pem") for name in ("ca", "own")}


def test_a_server_with_tls_and_tokens(
    file: str, pem: dict[str, str], tmp_path: Path, start_server, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = tmp_path / "token"
    token.write_text("user-token-0123456789\n")
    certificates = ("--tls-certificate", pem["own"], "--tls-key", pem["own"])
    flags = (*certificates, "--tls-client-ca", pem["ca"], "--token-file", str(token))
    with start_server("--backend", "dummy", *flags) as server:
        shown = (*certificates, "--tls-ca", pem["ca"])
        for address in (server.grpc_address, server.http_url):
            asked = ("--server", address, *shown)
            code, output = run("detect", file, *asked, "--token-file", str(token), "--json")
            assert code == 0, output
            assert len(json.loads(output)["grasps"]) == 10
            monkeypatch.setenv("EDGEGRASP_CLIENT_TOKEN", "user-token-0123456789")
            assert run("models", *asked)[0] == 0
            monkeypatch.delenv("EDGEGRASP_CLIENT_TOKEN")
            code, output = run("models", *asked)
            assert (code, "authorization: got nothing" in output) == (1, True)
            code, output = run("detect", file, "--server", address, "--tls-ca", pem["ca"])
            assert code == 1
    code, output = run("models", "--server", "127.0.0.1:1", "--token-file", str(tmp_path / "none"))
    assert (code, "token file" in output) == (1, True)


def test_a_device_that_is_not_there_is_named(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    code, output = run("detect", file, "--device", "cuda")
    assert code == 1
    assert "edgegrasp detect: device: got 'cuda'" in output
    code, output = run("detect", file, "--device", "gpu")
    assert code == 1
    assert "Use auto, cpu, cuda" in output
