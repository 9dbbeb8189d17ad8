import pytest
import torch

from edgegrasp_model.errors import InvalidDevice
from edgegrasp_model.on_device.choice import choose_device


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> int:
    """A PyTorch that sees so many GPUs."""
    count: int = request.param
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    return count


@pytest.mark.parametrize("gpus", [2], indirect=True)
def test_gpus_that_are_there_are_found(gpus: int) -> None:
    assert str(choose_device("auto")) == "cuda:0"
    assert str(choose_device("cuda")) == "cuda:0"
    assert str(choose_device("cuda:1")) == "cuda:1"
    assert str(choose_device("cpu")) == "cpu"
    with pytest.raises(InvalidDevice, match=r"device: got 'cuda:2'.*cuda:0 to cuda:1"):
        choose_device("cuda:2")


@pytest.mark.parametrize("gpus", [0], indirect=True)
def test_only_auto_falls_back_to_the_processor(gpus: int) -> None:
    assert str(choose_device("auto")) == "cpu"
    with pytest.raises(InvalidDevice, match=r"device: got 'cuda'.*use cpu or auto"):
        choose_device("cuda")


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "CPU", "", "mps"])
def test_other_names_are_refused_by_name(name: str) -> None:
    with pytest.raises(InvalidDevice, match=f"device: got '{name}'. Use auto, cpu, cuda"):
        choose_device(name)
