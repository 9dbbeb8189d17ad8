"""Which graphs are captured, kept and replayed; the capture itself needs a GPU."""

from typing import Any

import pytest
import torch
from torch import Tensor

from edgegrasp_model.on_device import captured
from edgegrasp_model.on_device.captured import Captured


class Recorded:
    """Stands for a CUDA graph: a replay computes from where the inputs were, to where it did."""

    def __init__(self, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        self.inputs, self.output = inputs, output

    def replay(self) -> None:
        self.output.copy_(added(*self.inputs))


class OnFakeGpu(Captured):
    captures = 0

    def _captures(self, inputs: tuple[Tensor, ...]) -> bool:
        return True

    def _capture(self, inputs: tuple[Tensor, ...]) -> Any:
        self.captures += 1
        own = tuple(torch.zeros_like(given) for given in inputs)
        output = added(*own)
        return captured._Graph(Recorded(own, output), own, output)  # type: ignore[arg-type]


def added(one: Tensor, other: Tensor) -> Tensor:
    return one + other


def test_one_capture_serves_every_call_of_its_shape() -> None:
    work = OnFakeGpu(added)
    assert work(torch.ones(3), torch.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert work.captures == 0  # it may never come again
    first = work(torch.ones(3), torch.ones(3))
    second = work(torch.ones(3), 2 * torch.ones(3))
    assert first.tolist() == [2.0, 2.0, 2.0]  # not written over by the second
    assert second.tolist() == [3.0, 3.0, 3.0]
    assert work.captures == 1
    for _ in range(2):
        assert work(torch.ones(4), torch.ones(4)).tolist() == [2.0] * 4
        assert work(torch.ones(4, dtype=torch.float64), torch.ones(4)).dtype == torch.float64
    assert work.captures == 3


def test_the_graph_not_used_for_longest_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captured, "KEPT", 2)
    work = OnFakeGpu(added)
    for size in (1, 1, 2, 2, 1, 3, 3, 1):  # 3 drives out 2
        work(torch.ones(size), torch.ones(size))
    assert work.captures == 3
    for _ in range(2):
        work(torch.ones(2), torch.ones(2))
    assert work.captures == 4


def test_elsewhere_it_is_a_plain_call() -> None:
    one = torch.ones(3, requires_grad=True)
    assert Captured(added)(one, torch.ones(3)).requires_grad
