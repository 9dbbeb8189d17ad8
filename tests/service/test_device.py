"""Where the server computes: a setting, told by /v1/models and metrics."""

import pytest
import torch

from edgegrasp_model.errors import InvalidDevice
from edgegrasp_service.backend import load_backend
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import InvalidSettings
from edgegrasp_service.settings import load_settings


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.parametrize("name", ["cpu", "auto"])
def test_the_loaded_weights_say_where_they_compute(no_gpu: None, name: str) -> None:
    facts = load_backend(load_settings(device=name)).describe()
    assert {each["device"] for each in facts} == {"cpu"}


def test_a_gpu_that_is_not_there_is_an_error_at_start(no_gpu: None) -> None:
    with pytest.raises(InvalidDevice, match="device: got 'cuda:1'"):
        load_backend(load_settings(device="cuda:1"))


async def test_a_server_does_not_start_without_its_device(no_gpu: None) -> None:
    settings = load_settings(device="cuda")
    service = GraspService(lambda: load_backend(settings), settings)
    with pytest.raises(InvalidDevice, match="use cpu or auto"):
        await service.start()
    assert not service.ready
    service.close()


def test_no_device_of_that_name() -> None:
    with pytest.raises(InvalidSettings, match=r"device: got 'gpu'.*It comes from --device"):
        load_settings(device="gpu")
