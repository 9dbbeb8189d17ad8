"""The configuration of a network, and the metadata of its checkpoint."""

from dataclasses import field
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

HAND_DESCRIPTION_SIZE = 87  # numbers
Architecture = Literal["edgegrasp", "vn-edgegrasp", "hand"]
Count = Annotated[int, Field(gt=0, strict=True)]
Metres = Annotated[float, Field(gt=0.0, lt=1.0)]
# Layers of each part of the paper's networks; the classifier may have any number.
_LAYERS = {"conv_widths": 3, "global_widths_1": 3, "global_widths_2": 2}


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NetworkConfig:
    """Shape of a network; widths count channels, which are 3-vectors in `vn-edgegrasp`."""

    architecture: Architecture
    conv_widths: tuple[Count, ...] = ()  # the three graph convolutions
    global_widths_1: tuple[Count, ...] = ()  # shared MLP before the first maximum over the ball
    global_widths_2: tuple[Count, ...] = ()  # shared MLP before the second
    classifier_widths: tuple[Count, ...] = ()  # hidden layers
    hand_widths: tuple[Count, ...] = ()  # of `hand`: shared MLP before the maximum over the points
    hand_points: Count = 128  # of `hand`: points around the fingers
    # Of `hand`: how many numbers of each hand description it reads, from the first.
    description_size: Annotated[Count, Field(le=HAND_DESCRIPTION_SIZE)] = 61
    k: Count = 16  # neighbours in the graph, the point itself included
    crop_radius: Metres = 0.05  # of the balls

    @model_validator(mode="after")
    def _check_layers(self) -> Self:
        of_hand = self.architecture == "hand"
        layers = {name: 0 if of_hand else count for name, count in _LAYERS.items()}
        layers["hand_widths"] = max(len(self.hand_widths), 1) if of_hand else 0
        layers["classifier_widths"] = max(len(self.classifier_widths), 1)
        for name, count in layers.items():
            if len(widths := getattr(self, name)) != count:
                raise ValueError(f"{name}: got {widths}. Give {count} positive whole numbers.")
        return self

    @property
    def local_width(self) -> int:
        """Channels of a point's local feature: the three convolutions side by side."""
        return sum(self.conv_widths)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CheckpointMetadata:
    """Metadata of a checkpoint; saving and loading fill in and check digests, SHA-256 in hex."""

    name: str  # the model's name, such as `edgegrasp-plus`
    network: NetworkConfig
    voxel_size: Metres  # of the clouds it was trained on
    gripper: str  # name of the gripper it was trained for
    # Calibration: probability = sigmoid(logit / temperature).
    temperature: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    training: dict[str, Any] = field(default_factory=dict)  # provenance, as JSON values
    tensors_digest: str = ""  # of the weights alone
    reference_logits: tuple[float, ...] = ()  # the network's logits for a fixed synthetic batch
    digest: str = ""  # of the whole file; empty unless loaded from one
