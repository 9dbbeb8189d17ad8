"""Networks of balls as they train: their first weights, and the unit of length."""

from copy import deepcopy

import torch
from torch import Tensor, nn

from edgegrasp_model.networks.edgegrasp import EdgeGraspNet
from edgegrasp_model.networks.vn_edgegrasp import VNEdgeGraspNet

# Metres. In metres the positions in a ball are far smaller than its normals, and learned late. A
# power of two, so that weights come back to metres exactly.
LENGTH_UNIT = 1 / 64
GAIN = 3**0.5  # a dozen layers of PyTorch's own weights shrink what passes them to nothing


def prepare_to_train(network: nn.Module) -> None:
    """Scale a network's random weights so that what passes it keeps its size; not one of hands."""
    if isinstance(network, EdgeGraspNet | VNEdgeGraspNet):
        with torch.no_grad():
            for module in network.modules():
                if isinstance(module, nn.Linear):
                    module.weight.mul_(GAIN)


def in_metres(network: nn.Module) -> nn.Module:
    """A copy of a network that takes lengths in multiples of LENGTH_UNIT, for metres."""
    return _scaled(network, 1.0 / LENGTH_UNIT)


def in_units(network: nn.Module) -> nn.Module:
    """A copy of a network that takes metres, for multiples of LENGTH_UNIT."""
    return _scaled(network, LENGTH_UNIT)


def _scaled(network: nn.Module, factor: float) -> nn.Module:
    copy = deepcopy(network)
    with torch.no_grad():
        for weight in _length_weights(copy):
            weight.mul_(factor)
    return copy


def _length_weights(network: nn.Module) -> list[Tensor]:
    """Views of the weights that multiply positions, offsets and depths; none in one of hands."""
    if isinstance(network, EdgeGraspNet):
        first, join = network.conv1.hidden.weight, network.join.weight
        later = [conv.hidden.weight[:, -3:] for conv in (network.conv2, network.conv3)]
        return [first[:, :3], first[:, 6:], *later, join[:, :3], join[:, 6]]
    if isinstance(network, VNEdgeGraspNet):
        first, frame = network.conv1.hidden.weight, network.frame_1
        later = [conv.hidden.weight[:, -1] for conv in (network.conv2, network.conv3)]
        seen = [frame.feature.weight[:, 1], frame.direction.weight[:, 1]]
        hidden = next(network.classifier.parameters())
        return [first[:, 0], first[:, 2], *later, *seen, hidden[:, 3:6]]
    return []
