"""What a network is: its architecture and widths, and what its checkpoint says of it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, Self, get_args

from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE

Architecture = Literal["edgegrasp", "vn-edgegrasp", "hand"]
# Layers of each part of the paper's networks; the classifier may be as deep as it likes.
_LAYERS = {"conv_widths": 3, "global_widths_1": 3, "global_widths_2": 2}


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network: a smaller network is another config, not another class.

    Widths count channels; in `vn-edgegrasp` a channel is a 3-vector. The paper's networks read
    balls of points, `hand` the points around the fingers of each hand.

    Raises:
        ValueError: A field is out of range; names the field, the value and the fix.
    """

    architecture: Architecture
    conv_widths: tuple[int, ...] = ()  # the three graph convolutions
    global_widths_1: tuple[int, ...] = ()  # shared MLP before the first maximum over the ball
    global_widths_2: tuple[int, ...] = ()  # shared MLP before the second
    classifier_widths: tuple[int, ...] = ()  # hidden layers
    hand_widths: tuple[int, ...] = ()  # of `hand`: shared MLP before the maximum over the points
    hand_points: int = 128  # of `hand`: points around the fingers
    description_size: int = 61  # of `hand`: numbers it reads of each hand description, the first
    k: int = 16  # neighbours in the graph, the point itself included
    crop_radius: float = 0.05  # ball radius, metres

    def __post_init__(self) -> None:
        if self.architecture not in get_args(Architecture):
            known = ", ".join(get_args(Architecture))
            raise ValueError(f"architecture: got {self.architecture!r}. Use one of: {known}.")
        of_hand = self.architecture == "hand"
        layers = {name: 0 if of_hand else count for name, count in _LAYERS.items()}
        layers["hand_widths"] = max(len(self.hand_widths), 1) if of_hand else 0
        layers["classifier_widths"] = max(len(self.classifier_widths), 1)
        for name, count in layers.items():
            widths = tuple(getattr(self, name))
            object.__setattr__(self, name, widths)
            if len(widths) != count or not all(_is_count(width) for width in widths):
                raise ValueError(f"{name}: got {widths}. Give {count} positive whole numbers.")
        for name in ("hand_points", "description_size", "k"):
            if not _is_count(getattr(self, name)):
                value = getattr(self, name)
                raise ValueError(f"{name}: got {value!r}. Give a positive whole number.")
        if self.description_size > HAND_DESCRIPTION_SIZE:
            raise ValueError(
                f"description_size: got {self.description_size}. This version describes hands by "
                f"{HAND_DESCRIPTION_SIZE} numbers."
            )
        if not 0.0 < self.crop_radius < 1.0:
            raise ValueError(f"crop_radius: got {self.crop_radius!r}. Give metres, such as 0.05.")

    @property
    def local_width(self) -> int:
        """Channels of a point's local feature: the three convolutions side by side."""
        return sum(self.conv_widths)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self).items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Reads what `to_dict` wrote.

        Raises:
            ValueError: A field is unknown, missing, of the wrong type or out of range.
        """
        known = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ValueError(
                f"network: unknown fields {', '.join(unknown)}. Known: {', '.join(sorted(known))}."
            )
        try:
            return cls(**values)
        except TypeError as error:
            raise ValueError(f"network: {error}.") from error


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


# The paper's network (section IV-B and the authors' release): 3.05 M parameters.
EDGEGRASP = NetworkConfig(
    architecture="edgegrasp",
    conv_widths=(32, 64, 128),
    global_widths_1=(256, 512, 512),
    global_widths_2=(1024, 1024),
    classifier_widths=(512, 256, 128),
)


# Its rotation-invariant variant of Vector Neurons: 1.70 M parameters.
VN_EDGEGRASP = NetworkConfig(
    architecture="vn-edgegrasp",
    conv_widths=(32, 64, 128),
    global_widths_1=(128, 128, 128),
    global_widths_2=(381, 381),
    classifier_widths=(256, 128, 64),
)


# An eighth of the paper's network (0.39 M parameters), for machines without a GPU.
EDGEGRASP_SMALL = NetworkConfig(
    architecture="edgegrasp",
    conv_widths=(32, 64, 128),
    global_widths_1=(128, 128, 128),
    global_widths_2=(256, 256),
    classifier_widths=(256, 128),
)


# Scores each edge grasp in the frame of its own hand; 0.13 M parameters.
HAND = NetworkConfig(
    architecture="hand",
    hand_widths=(32, 64, 128),
    classifier_widths=(256, 128),
    description_size=HAND_DESCRIPTION_SIZE,
)


@dataclass(frozen=True)
class CheckpointMetadata:
    """What a checkpoint says of itself.

    `save_checkpoint` fills in `tensors_digest` and `reference_logits`, which `load_checkpoint`
    checks; it fills in the file's `digest`. Digests are SHA-256, in hex.

    Raises:
        ValueError: A field is out of range; names the field, the value and the fix.
    """

    name: str  # the model's name, such as `edgegrasp-plus`
    network: NetworkConfig
    voxel_size: float  # metres; the clouds it was trained on
    gripper: str  # name of the gripper it was trained for
    temperature: float = 1.0  # calibration: probability = sigmoid(logit / temperature)
    training: dict[str, Any] = field(default_factory=dict)  # provenance, as JSON values
    tensors_digest: str = ""  # of the weights alone
    reference_logits: tuple[float, ...] = ()  # what the network says of a fixed made-up batch
    digest: str = ""  # of the whole file; empty until it was loaded from one

    def __post_init__(self) -> None:
        if not 0.0 < self.voxel_size < 1.0:
            raise ValueError(f"voxel_size: got {self.voxel_size!r}. Give metres, such as 0.0045.")
        if not 0.0 < self.temperature < float("inf"):
            raise ValueError(f"temperature: got {self.temperature!r}. Give a positive number.")
