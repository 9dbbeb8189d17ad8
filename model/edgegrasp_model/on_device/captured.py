"""Work of fixed shapes that a GPU replays as one CUDA graph."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

KEPT = 64  # graphs; the one not used for longest goes
WARM_UP_RUNS = 2  # libraries choose their kernels and get their workspace before the capture


class _Graph(NamedTuple):
    graph: torch.cuda.CUDAGraph
    inputs: tuple[Tensor, ...]
    output: Tensor


class Captured:
    """Calls a function; on a GPU it is captured for each shape of its inputs, then replayed.

    A replay is one launch, allocates nothing and compiles nothing. A shape is captured when it
    comes for the second time: the first may have been the only one. Elsewhere than on a GPU it is
    a plain call. May be called from several threads, one after the other.

    Args:
        function: Of tensors of one device; must not wait for the device, nor look at values.
    """

    def __init__(self, function: Callable[..., Tensor]) -> None:
        self._function = function
        self._graphs: OrderedDict[tuple[object, ...], _Graph | None] = OrderedDict()  # None: once
        self._pool: Any = None  # memory that all graphs share: one runs at a time
        self._turn = threading.Lock()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """What the function returns for these inputs."""
        if not self._captures(inputs):
            return self._function(*inputs)
        shapes = tuple((given.shape, given.dtype, given.device) for given in inputs)
        with self._turn, torch.inference_mode():
            known = shapes in self._graphs
            captured = self._graphs.pop(shapes, None) or (self._capture(inputs) if known else None)
            self._graphs[shapes] = captured
            if len(self._graphs) > KEPT:
                self._graphs.popitem(last=False)
            if captured is None:
                return self._function(*inputs)
            for there, given in zip(captured.inputs, inputs, strict=True):
                there.copy_(given)
            captured.graph.replay()
            return captured.output.clone()  # the next replay writes over it

    def _captures(self, inputs: tuple[Tensor, ...]) -> bool:
        return inputs[0].device.type == "cuda"

    def _capture(self, inputs: tuple[Tensor, ...]) -> _Graph:
        own = tuple(given.clone() for given in inputs)
        with torch.cuda.device(own[0].device):
            beside: Any = torch.cuda.Stream()  # type: ignore[no-untyped-call]
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                for _ in range(WARM_UP_RUNS):
                    self._function(*own)
            torch.cuda.current_stream().wait_stream(beside)
            graph = torch.cuda.CUDAGraph()
            self._pool = self._pool or torch.cuda.graph_pool_handle()
            # Other threads prepare their requests meanwhile: their launches are no part of this.
            capture = torch.cuda.graph(
                graph, pool=self._pool, stream=beside, capture_error_mode="thread_local"
            )
            with capture:
                output = self._function(*own)
        return _Graph(graph, own, output)
