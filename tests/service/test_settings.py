"""Defaults, then a file, then the environment, then flags; every mistake named with its source."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from tests.cli.commands import run

from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.settings import Settings, load_settings

TOKEN = "a-token-of-enough-letters"


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("EDGEGRASP_"):
            monkeypatch.delenv(name)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return tmp_path / "server.toml"


def test_each_source_wins_over_the_one_before(monkeypatch, config) -> None:
    config.write_text("http_port = 1\ngrpc_port = 1\nmax_points = 1\n")
    monkeypatch.setenv("EDGEGRASP_CONFIG", str(config))
    monkeypatch.setenv("EDGEGRASP_HTTP_PORT", "2")
    monkeypatch.setenv("EDGEGRASP_GRPC_PORT", "2")
    settings = load_settings(http_port=3)
    assert load_settings(config).http_port == 2
    assert Settings().http_port == 8000  # made directly it reads nothing
    assert (settings.http_port, settings.grpc_port, settings.max_points) == (3, 2, 1)


@pytest.mark.parametrize("source", ["a flag", "the environment", "server.toml"])
def test_a_mistake_is_told_with_its_source(monkeypatch, config, source) -> None:
    config.write_text("http_port = -1\n" if source == "server.toml" else "http_port = 1\n")
    monkeypatch.setenv("EDGEGRASP_HTTP_PORT", "-1" if source == "the environment" else "")
    with pytest.raises(InvalidSettings, match=f"http_port: got .*It comes from .*{source}"):
        load_settings(config, **({"http_port": -1} if source == "a flag" else {}))


def test_paths_in_a_file_are_relative_to_it_and_in_the_environment_json(monkeypatch, config):
    config.write_text('weights = ["mine", "/there/yours"]\ntoken_file = "tokens"\n')
    settings = load_settings(config)
    assert settings.weights == (config.parent / "mine", Path("/there/yours"))
    assert settings.token_file == config.parent / "tokens"
    monkeypatch.setenv("EDGEGRASP_WEIGHTS", '["a", "b.safetensors"]')
    assert load_settings().weights == (Path("a"), Path("b.safetensors"))
    monkeypatch.setenv("EDGEGRASP_WEIGHTS", "folder")
    with pytest.raises(InvalidSettings, match="Write lists as JSON"):
        load_settings()


@pytest.mark.parametrize(
    ("given", "sentence"),  # flags, or the text of a file; None: there is no file
    [
        ({"http_port": -1}, "http_port: got -1. Input should be greater"),
        ({"htp_port": 1}, "htp_port: no such setting"),
        ({"log_level": "none"}, "log_level: got 'none'"),
        ({"max_body_bytes": "many"}, "max_body_bytes: got 'many'"),
        ({"weights": [1]}, "weights.0: got 1"),
        ({"tls_key": "key.pem"}, "tls_certificate and tls_key go together"),
        ({"tls_client_ca": "ca.pem"}, "tls_client_ca needs tls_certificate"),
        ({"grace_seconds": float("nan")}, "grace_seconds: got nan"),
        ("htttp_port = 1\n", "htttp_port: no such setting"),
        ("[tls]\nkey = 1\n", "tls: no such setting"),
        ('http_port = "many"\n', "http_port: got 'many'"),
        ("http_port 1\n", "server.toml: Expected '=' after a key"),
        ("http_port = \xff\n", "server.toml:"),
        (None, "no such file"),
    ],
)
def test_bad_settings_and_files_are_named(config: Path, given: Any, sentence: str) -> None:
    if isinstance(given, str):
        config.write_bytes(given.encode("latin-1"))
    flags = given if isinstance(given, dict) else {"config": config}
    with pytest.raises(InvalidSettings) as caught:
        load_settings(**flags)
    assert sentence in str(caught.value)
    assert isinstance(given, dict) or "server.toml" in str(caught.value)


@pytest.mark.parametrize("name", ["htp_port", "token", "config_file"])
def test_unknown_variables_are_named_but_for_a_clients(monkeypatch, name: str) -> None:
    monkeypatch.setenv("EDGEGRASP_CLIENT_TOKEN", TOKEN)
    monkeypatch.setenv("EDGEGRASP_HOST", "")  # as a compose file leaves what is not set
    assert load_settings().host == "127.0.0.1"
    monkeypatch.setenv(f"EDGEGRASP_{name.upper()}", TOKEN)
    with pytest.raises(InvalidSettings) as caught:
        load_settings()
    assert str(caught.value) == f"{name}: no such setting. It comes from the environment."


def test_the_settings_in_effect_are_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EDGEGRASP_GRPC_PORT", "7")
    flags = ("--print-config", "--http-port", "9", "--weights", "/a", "--weights", "/b")
    printed = json.loads(run("serve", *flags))
    assert (printed["http_port"], printed["grpc_port"]) == (9, 7)
    assert printed["weights"] == ["/a", "/b"]
    assert set(printed) == set(Settings.model_fields)
