from pathlib import Path

import pytest

from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.settings import load_settings


def test_defaults() -> None:
    settings = load_settings()
    assert (settings.host, settings.http_port, settings.grpc_port) == ("127.0.0.1", 8000, 50051)
    assert settings.max_body_bytes == 32 * 2**20


def test_environment_wins_over_defaults_and_arguments_over_both(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("EDGEGRASP_HTTP_PORT", "8001")
    monkeypatch.setenv("EDGEGRASP_GRPC_PORT", "8002")
    monkeypatch.setenv("EDGEGRASP_WEIGHTS", '["a", "b.safetensors"]')
    settings = load_settings(http_port=9000)
    assert (settings.http_port, settings.grpc_port) == (9000, 8002)
    assert settings.weights == (Path("a"), Path("b.safetensors"))


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"http_port": -1}, "http_port: got -1"),
        ({"htp_port": 1}, "htp_port: got 1. Extra inputs are not permitted"),
        ({"backend": "none"}, "backend: got 'none'"),
        ({"max_body_bytes": "many"}, "max_body_bytes: got 'many'"),
    ],
)
def test_bad_settings_are_named(given: dict[str, object], sentence: str) -> None:
    with pytest.raises(InvalidSettings) as caught:
        load_settings(**given)
    assert sentence in str(caught.value)


def test_bad_environment_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EDGEGRASP_WEIGHTS", "folder")
    with pytest.raises(InvalidSettings, match="Write lists as JSON"):
        load_settings()
