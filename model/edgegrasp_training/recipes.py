"""The networks that can be trained: their sizes, initial weights, and unit of length."""

from copy import deepcopy
from functools import partial

import torch
from torch import Tensor, nn

from edgegrasp_model.networks.checkpoint import NETWORKS
from edgegrasp_model.networks.config import HAND_DESCRIPTION_SIZE, CheckpointMetadata, NetworkConfig
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet
from edgegrasp_model.networks.hand import HandNet
from edgegrasp_model.networks.vn_edgegrasp import VNEdgeGraspNet

CROP_RADIUS = 0.04  # metres; half the gripper's opening, as in the paper
VOXEL_SIZE = 0.0045  # metres; the same as in the training views
# Metres. In metres, positions in a ball are far smaller than normals, and are learned late. A power
# of two makes converting weights back to metres exact.
LENGTH_UNIT = 1 / 64
CONSTANT = 1e-6  # standard deviation below which a number of the description counts as constant
# With PyTorch's initial weights the dozen layers of a ball network would shrink signals to nothing.
GAIN = 3**0.5
LOCAL = (32, 64, 128)  # widths of the layers that see a point and its neighbours
_sized = partial(NetworkConfig, crop_radius=CROP_RADIUS)
# Widths of ball networks: local layers, layers before each maximum over the ball, classifier.
RECIPES = {
    # The paper's network (section IV-B and the authors' release): 3.05 M parameters.
    "edgegrasp": _sized("edgegrasp", LOCAL, (256, 512, 512), (1024, 1024), (512, 256, 128)),
    # An eighth of the paper's network (0.39 M parameters), for machines without a GPU.
    "edgegrasp-small": _sized("edgegrasp", LOCAL, (128, 128, 128), (256, 256), (256, 128)),
    # Scores each edge grasp in its hand frame; 0.13 M parameters.
    "edgegrasp-plus": _sized(
        architecture="hand",
        hand_widths=LOCAL,
        classifier_widths=(256, 128),
        description_size=HAND_DESCRIPTION_SIZE,
    ),
    # The paper's rotation-invariant variant, of Vector Neurons: 1.70 M parameters.
    "vn-edgegrasp": _sized("vn-edgegrasp", LOCAL, (128, 128, 128), (381, 381), (256, 128, 64)),
}


def recipe(name: str) -> CheckpointMetadata:
    """The metadata of a new network with this name; raises ValueError for an unknown name."""
    if name not in RECIPES:
        raise ValueError(f"model: got {name!r}. Use one of: {', '.join(RECIPES)}.")
    return CheckpointMetadata(name, RECIPES[name], VOXEL_SIZE, gripper="panda")


def build_network(config: NetworkConfig, generator: torch.Generator | None = None) -> nn.Module:
    """Build a network with random weights, from the generator or from seed 0."""
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    # Layers initialise themselves from the global random stream, which is restored here.
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.set_rng_state(generator.get_state())
        network = NETWORKS[config.architecture](config)
        if config.architecture != "hand":
            for module in network.modules():
                if isinstance(module, nn.Linear):
                    module.weight.mul_(GAIN)
    return network


def set_statistics(network: HandNet, mean: Tensor, std: Tensor) -> None:
    """Store mean (F,) and standard deviation (F,) of the training data's descriptions."""
    size = network.config.description_size
    network.mean.copy_(mean[:size])
    # A number that never varied in training, such as the only hand's opening, must have little
    # weight.
    network.std.copy_(torch.where(std < CONSTANT, 1.0, std.clamp_min(1e-3))[:size])


def start_from(network: nn.Module, start: nn.Module) -> None:
    """Copy the weights of a network that takes lengths in metres; ValueError: another model."""
    try:
        network.load_state_dict(rescaled(start, LENGTH_UNIT).state_dict())
    except RuntimeError:  # its message lists dozens of layers
        found = f"{type(start).__name__} to train {type(network).__name__}"
        raise ValueError(f"start_from: got {found}. Give weights of the same model.") from None


def rescaled(network: nn.Module, factor: float) -> nn.Module:
    """A copy with scaled weights of lengths; with LENGTH_UNIT, its input is in that unit."""
    copy = deepcopy(network)
    with torch.no_grad():
        for weight in _length_weights(copy):
            weight.mul_(factor)
    return copy


def _length_weights(network: nn.Module) -> list[Tensor]:
    """Views of the weights that multiply lengths; none in the hand network."""
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
