"""Checkpoints: a network's weights and metadata in one safetensors file.

The file's metadata contains JSON under the key `edgegrasp`; nothing in it is ever executed.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.config import Architecture, CheckpointMetadata, NetworkConfig
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet
from edgegrasp_model.networks.hand import HandBatch, HandNet
from edgegrasp_model.networks.vn_edgegrasp import VNEdgeGraspNet

_METADATA_KEY = "edgegrasp"
_FORMAT = 1
MAX_DIFFERENCE = 0.05  # mean difference of the reference logits, as a share of their range
NETWORKS: dict[Architecture, Callable[[NetworkConfig], nn.Module]] = {
    "edgegrasp": EdgeGraspNet,
    "vn-edgegrasp": VNEdgeGraspNet,
    "hand": HandNet,
}


def save_checkpoint(path: Path, network: nn.Module, metadata: CheckpointMetadata) -> None:
    """Write a checkpoint atomically; equal weights and metadata make equal bytes."""
    tensors = {name: value.contiguous().cpu() for name, value in network.state_dict().items()}
    values = asdict(metadata) | {
        "format": _FORMAT,
        "tensors_digest": _digest(tensors),
        "reference_logits": [round(logit, 4) for logit in reference_logits(network)],
    }
    del values["digest"]
    text = json.dumps(values, sort_keys=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(save(tensors, metadata={_METADATA_KEY: text}))  # save_file sets mode 600
    partial.replace(path)


def load_checkpoint(path: Path) -> tuple[nn.Module, CheckpointMetadata]:
    """Load a checkpoint under its file's name, in evaluation mode; raises InvalidCheckpoint."""
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            values = dict(json.loads((file.metadata() or {})[_METADATA_KEY]))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if (written := values.pop("format")) != _FORMAT:
            raise ValueError(f"format: got {written!r}. This version reads {_FORMAT}.")
        metadata = CheckpointMetadata(**values)
        if metadata.tensors_digest not in ("", _digest(tensors)):
            raise ValueError("the weights differ from those that were written")
        if not all(tensor.isfinite().all() for tensor in tensors.values()):
            raise ValueError("the weights contain NaN or infinity")
        with torch.device("meta"):
            network = NETWORKS[metadata.network.architecture](metadata.network)
        network.load_state_dict(tensors, assign=True)
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise InvalidCheckpoint(
            f"checkpoint: got {path}, whose weights or edgegrasp metadata are unusable "
            f"({error!r}). Restore the file from a copy, or write it again with `edgegrasp train` "
            "or `edgegrasp import-checkpoint`."
        ) from error
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return network.eval(), replace(metadata, digest=digest, name=path.stem)


def check_reference_logits(network: nn.Module, metadata: CheckpointMetadata) -> None:
    """Raise InvalidCheckpoint unless the network gives the stored logits, within MAX_DIFFERENCE."""
    found = np.asarray(reference_logits(network))
    expected = np.asarray(metadata.reference_logits or found)
    tolerance = MAX_DIFFERENCE * np.ptp(expected) + 1e-3
    if not np.abs(found - expected).mean() <= tolerance:  # written this way, NaN fails too
        raise InvalidCheckpoint(
            f"checkpoint: the network of {metadata.name!r} does not give the logits it was written "
            "with. Check this installation of PyTorch and Numba, or restore the file from a copy."
        )


def reference_logits(network: nn.Module) -> list[float]:
    """The logits of a network of any architecture for a fixed synthetic batch."""
    config: NetworkConfig = network.config  # type: ignore[assignment]
    device = next(network.parameters()).device
    kind: type[HandBatch | BallBatch] = HandBatch if config.architecture == "hand" else BallBatch
    with torch.inference_mode(), torch.autocast(device.type, enabled=False):
        logits: list[float] = network(kind.synthetic(config).to(device)).float().tolist()
    return logits


def _digest(tensors: Mapping[str, Tensor]) -> str:
    parts = (name.encode() + tensors[name].numpy().tobytes() for name in sorted(tensors))
    return hashlib.sha256(b"".join(parts)).hexdigest()
