"""The models a process has loaded, by name, and the device they run on."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.errors import InvalidCheckpoint, InvalidDevice, UnknownModel
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.scene import MAX_VOXELS

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
PREFERRED = ("edgegrasp-plus", "edgegrasp", "edgegrasp-small", "vn-edgegrasp")
DEVICE_NAMES = re.compile(r"auto|cpu|cuda(:\d+)?")


class ModelCatalogue:
    """Named detectors, one of them the default."""

    def __init__(self, detectors: Mapping[str, GraspDetector], default: str = "") -> None:
        """Collect detectors.

        Args:
            detectors: By name; at least one.
            default: Name to use where a request names none; empty: the best that is there.

        Raises:
            UnknownModel: There is no detector of the default's name.
            InvalidCheckpoint: There is no detector at all.
        """
        if not detectors:
            raise InvalidCheckpoint("weights: found none. Give a folder with .safetensors files.")
        self._detectors = dict(detectors)
        preferred = [name for name in PREFERRED if name in detectors] or sorted(detectors)
        self.default = default or preferred[0]
        self.get(self.default)

    @classmethod
    def load(
        cls,
        weights: Sequence[Path] = (),
        default: str = "",
        device: torch.device | str = "cpu",
        grippers: Sequence[Path] = (),
        max_voxels: int = MAX_VOXELS,
    ) -> Self:
        """Load the weights that ship with the package, then a user's own, which win by name.

        Args:
            weights: `.safetensors` files, or folders of them; a model is named as its file.
            default: As for the constructor.
            device: Where the networks run.
            grippers: Gripper files that requests may name by their stem.
            max_voxels: Most voxels that a request's cloud may have.

        Raises:
            InvalidCheckpoint: A file cannot be used, or there is none.
            UnknownModel: There are no weights of the default's name.
            InvalidGripper: A gripper file cannot be used.
        """
        own = {file.stem: load_gripper(file) for file in grippers}
        files: dict[str, Path] = {}
        for source in (WEIGHTS_FOLDER, *weights):
            found = sorted(source.glob("*.safetensors")) if source.is_dir() else [source]
            files |= {
                file.stem: file for file in found if source != WEIGHTS_FOLDER or file.exists()
            }
        detectors = {
            name: GraspDetector.load(file, device, own, max_voxels) for name, file in files.items()
        }
        return cls(detectors, default)

    def names(self) -> list[str]:
        """Names of the models, sorted."""
        return sorted(self._detectors)

    def get(self, name: str = "") -> GraspDetector:
        """The detector of a name; of the default for an empty one.

        Raises:
            UnknownModel: There is none.
        """
        try:
            return self._detectors[name or self.default]
        except KeyError:
            raise UnknownModel(name or self.default, self._detectors) from None

    def describe(self) -> list[dict[str, Any]]:
        """What each model is, as plain JSON values."""
        return [
            {
                "name": name,
                "default": name == self.default,
                "architecture": detector.metadata.network.architecture,
                "parameters": sum(p.numel() for p in detector.network.parameters()),
                "digest": detector.metadata.digest,
                "crop_radius": detector.metadata.crop_radius,
                "voxel_size": detector.metadata.voxel_size,
                "gripper": detector.metadata.gripper,
                "hand_description": detector.sees_hands,
                "device": str(detector.device),
            }
            for name, detector in sorted(self._detectors.items())
        ]

    def warm_up(self) -> None:
        """Run every model once on a small made-up cloud, so that the first request is not slow.

        A few candidates take every path that a request takes, in a tenth of the time.
        """
        rng = np.random.default_rng(0)
        box = rng.uniform(-1.0, 1.0, (2000, 3)) * (0.02, 0.03, 0.04)
        options = DetectOptions(
            viewpoint=(0.0, 0.0, 0.5), num_approach_points=4, num_candidates=100
        )
        for detector in self._detectors.values():
            detector.detect(box, options)


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
