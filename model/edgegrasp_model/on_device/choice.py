"""Which device a process computes on."""

import re

import torch

from edgegrasp_model.errors import InvalidDevice

DEVICE_NAMES = re.compile(r"auto|cpu|cuda(:\d+)?")


def choose_device(name: str = "auto") -> torch.device:
    """The device of a name, if it is there.

    Args:
        name: `cpu`; `cuda`, the first GPU; `cuda:1` the second, and so on; `auto`: the first GPU
            where there is one, else the processor.

    Raises:
        InvalidDevice: It is no device's name, or there is no such device here.
    """
    if not DEVICE_NAMES.fullmatch(name):
        raise InvalidDevice(name, "Use auto, cpu, cuda, or cuda:N for one GPU of several.")
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda:0" if gpus else "cpu")
    device = torch.device(name)
    if device.type == "cpu":
        return device
    number = device.index or 0
    if number < gpus:
        return torch.device("cuda", number)
    if gpus:
        here = "cuda:0" if gpus == 1 else f"cuda:0 to cuda:{gpus - 1}"
        raise InvalidDevice(name, f"PyTorch sees {here} here: use one of them, auto or cpu.")
    built = "sees no GPU" if torch.version.cuda else "is built without CUDA"
    raise InvalidDevice(name, f"PyTorch {torch.__version__} {built} here: use cpu or auto.")
