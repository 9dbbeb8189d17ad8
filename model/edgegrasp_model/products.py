"""Matrix products of the networks; in inference no bit of a row depends on the other rows.

So a request's scores are the same alone and in a batch, on a processor.
"""

from functools import cache

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

# Products of fewer rows add up in an order that depends on how many there are.
MIN_ROWS = 32


def row_linear(values: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """F.linear of values (M, ..., C)."""
    if torch.is_grad_enabled() or values.device.type != "cpu":
        return F.linear(values, weight, bias)
    if len(weight) == 1:  # a product with a vector, which has an order of its own for each size
        product = (values * weight[0]).sum(dim=-1, keepdim=True)
        return product if bias is None else product + bias
    if 0 < values.shape[:-1].numel() < MIN_ROWS:
        padded = values.new_zeros((MIN_ROWS, *values.shape[1:]))
        padded[: len(values)] = values
        return F.linear(padded, weight, bias)[: len(values)]
    return F.linear(values, weight, bias)


class Product:
    """A linear layer on many pieces of rows, one after another, by the faster of two libraries.

    For as long as the weights stay as they are: one forward pass.
    """

    def __init__(
        self, weight: Tensor, bias: Tensor | None = None, *, rectified: bool = False
    ) -> None:
        """Prepare the weights.

        Args:
            weight: (outputs, C), any part of a matrix.
            bias: (outputs,), or none.
            rectified: Whether a ReLU follows.
        """
        self._weight, self._bias, self._rectified = weight, bias, rectified
        self._packed = _packed(weight)

    def __call__(self, values: Tensor) -> Tensor:
        """Maps (M, ..., C) to (M, ..., outputs).

        oneDNN prepares anew for each number of rows: let all pieces have the same.
        """
        if self._packed is None:
            rows = row_linear(values, self._weight, self._bias)
            return rows.relu_() if self._rectified else rows
        then = "relu" if self._rectified else "none"
        result: Tensor = torch.ops.mkldnn._linear_pointwise(
            values, self._packed, self._bias, then, [], ""
        )
        return result


class MlpProducts:
    """The linear layers of an MLP as `Product`s, with their ReLUs."""

    def __init__(self, mlp: nn.Sequential) -> None:
        layers = linear_layers(mlp)
        self._products = [
            Product(layer.weight, layer.bias, rectified=layer is not layers[-1]) for layer in layers
        ]

    def __call__(self, values: Tensor) -> Tensor:
        """Maps (M, ..., C) to (M, ..., outputs)."""
        for product in self._products:
            values = product(values)
        return values


def linear_layers(mlp: nn.Sequential) -> list[nn.Linear]:
    """The linear layers of an MLP, in order."""
    return [layer for layer in mlp if isinstance(layer, nn.Linear)]


@cache
def onednn_is_faster() -> bool:
    """Whether oneDNN multiplies in float32 about twice as fast as MKL, which is behind F.linear.

    So it is on AMD processors with AVX-512, measured on an EPYC.
    """
    ours = torch.backends.cpu.get_cpu_capability() == "AVX512" and "AMD" in _processor()
    there = torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
    return ours and there and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")


def _processor() -> str:
    """The processor's name."""
    get = getattr(torch.cpu, "get_capabilities", None)  # newer PyTorch has it
    return "" if get is None else str(get().get("cpu_name", ""))


def float32_inference(values: Tensor) -> bool:
    """Whether nothing but float32 on a processor is asked for."""
    return (
        values.device.type == "cpu"
        and values.dtype == torch.float32
        and not torch.is_grad_enabled()
        and not torch.is_autocast_enabled("cpu")
    )


def _packed(weight: Tensor) -> Tensor | None:
    """A weight as oneDNN reads it; None where the plain product serves."""
    if len(weight) == 1 or not (float32_inference(weight) and onednn_is_faster()):
        return None
    packed: Tensor = torch.ops.mkldnn._reorder_linear_weight(weight.detach().contiguous())
    return packed
