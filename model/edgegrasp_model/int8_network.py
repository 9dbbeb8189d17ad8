"""EdgeGraspNet in int8: the products over points and neighbours, nine tenths of its work."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, cast

import torch
from torch import Tensor, nn

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.int8_layers import (
    Int8GlobalFeature,
    Int8PointNetConv,
    point_parts,
)
from edgegrasp_model.layers import gather_rows
from edgegrasp_model.network import EdgeGraspNet
from edgegrasp_model.network_config import NetworkConfig
from edgegrasp_model.products import linear_layers

INT8: Final = "edgegrasp-int8"
COVERED = 0.9999  # share of a product's inputs on a view that its range is made for
SAMPLED = 1 << 20  # inputs of a product looked at in each batch


class Int8EdgeGraspNet(EdgeGraspNet):
    """EdgeGraspNet whose layers over points are on bytes; first layers and classifier are not."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width_1, width_2, width_3 = config.conv_widths
        layers: dict[str, nn.Module] = {
            "conv1": Int8PointNetConv(3 + 3, width_1),
            "conv2": Int8PointNetConv(width_1, width_2),
            "conv3": Int8PointNetConv(width_2, width_3),
            "ball_feature": Int8GlobalFeature(
                config.local_width, config.global_widths_1, config.global_widths_2
            ),
        }
        for name, layer in layers.items():
            setattr(self, name, layer)


def check_quantisable(config: NetworkConfig) -> None:
    """Raise ValueError unless networks of a config can be quantised."""
    if config.architecture != "edgegrasp":
        raise ValueError(
            f"architecture: got {config.architecture!r}. int8 is for edgegrasp networks in float32."
        )


def quantise(network: EdgeGraspNet, batches: Sequence[BallBatch]) -> Int8EdgeGraspNet:
    """The same network in int8.

    Args:
        network: In float32.
        batches: Balls as it will meet them: they say how large its features become. A dozen views
            are plenty; nothing is trained.

    Raises:
        ValueError: The network is another one, or there are no batches.
    """
    check_quantisable(network.config)
    if not batches:
        raise ValueError("batches: got none. Give balls to measure the features on.")
    largest = _largest_inputs(network, batches)
    result = Int8EdgeGraspNet(replace(network.config, architecture=INT8))
    with torch.no_grad():
        for name in ("conv1", "conv2", "conv3"):
            cast(Any, getattr(result, name)).fill(getattr(network, name), largest[name])
        hidden = [largest["hidden_1"], largest["hidden_2"]]
        feature = cast(Any, result.ball_feature)
        feature.fill(network.ball_feature, largest["local"], hidden, largest["joined"])
    result.join.load_state_dict(network.join.state_dict())
    result.classifier.load_state_dict(network.classifier.state_dict())
    return result.eval()


def _largest_inputs(network: EdgeGraspNet, batches: Sequence[BallBatch]) -> dict[str, float]:
    """What goes into each product, less a few of the largest, over all batches."""
    largest: dict[str, float] = {}

    def look(name: str, values: Tensor) -> None:
        sample = values.flatten()[:: max(values.numel() // SAMPLED, 1)]
        kept = max(round((1 - COVERED) * len(sample)), 1)
        largest[name] = max(largest.get(name, 0.0), float(sample.topk(kept).values[-1]))

    def convolution(name: str) -> Any:
        def before(layer: Any, inputs: tuple[Tensor, BallBatch]) -> None:
            u, v = point_parts(layer.hidden, *inputs)
            some = slice(None, None, 8)
            look(name, gather_rows(u, inputs[1].neighbors[some]) - v[some].unsqueeze(1))

        return before

    def ball_feature(layer: Any, inputs: tuple[Tensor, BallBatch]) -> None:
        local, batch = inputs
        look("local", local)
        first, second, last = linear_layers(layer.mlp_1)
        for points in torch.split(local, batch.ball_sizes):
            hidden_1 = first(points)
            hidden_2 = second(hidden_1.relu())
            ball = last(hidden_2.relu()).amax(dim=0, keepdim=True)  # (1, 512)
            joined = layer.join(points, ball, points.new_zeros(len(points), dtype=torch.int64))
            for name, values in (
                ("hidden_1", hidden_1),
                ("hidden_2", hidden_2),
                ("joined", joined),
            ):
                look(name, values)

    hooks = [
        getattr(network, name).register_forward_pre_hook(convolution(name))
        for name in ("conv1", "conv2", "conv3")
    ]
    hooks.append(network.ball_feature.register_forward_pre_hook(ball_feature))
    try:
        with torch.inference_mode():
            for batch in batches:
                network(batch)
    finally:
        for hook in hooks:
            hook.remove()
    return largest
