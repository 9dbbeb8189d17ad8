"""Weights in int8 from trained ones, measured on labelled views."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.checkpoint import CheckpointMetadata
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.int8_network import INT8, Int8EdgeGraspNet, check_quantisable, quantise
from edgegrasp_model.network import EdgeGraspNet
from edgegrasp_model.options import DetectOptions
from edgegrasp_training.views import LabelledView, load_view

VIEWS = 16  # looked at, at most
APPROACH_POINTS, CANDIDATES = 16, 500  # in each of them


def quantise_detector(
    detector: GraspDetector, views: Sequence[Path]
) -> tuple[Int8EdgeGraspNet, CheckpointMetadata, float]:
    """Quantise a detector's network.

    Args:
        detector: Its network is an EdgeGraspNet in float32.
        views: Files of views; those looked at are spread evenly over them.

    Returns:
        The network in int8, what to say of it, and the correlation of its logits with the
        network's own over candidates of the views looked at.

    Raises:
        ValueError: The network is of another architecture, or the views hold no candidate.
    """
    metadata = detector.metadata
    check_quantisable(metadata.network)
    spread = {views[at * len(views) // VIEWS] for at in range(VIEWS)} if views else set()
    prepared = [_batch(detector, load_view(path)) for path in sorted(spread)]
    batches = [batch for batch in prepared if batch is not None]
    network = cast(EdgeGraspNet, detector.network)
    result = quantise(network, batches)
    with torch.inference_mode():
        own = torch.cat([network(batch) for batch in batches]).numpy()
        logit = torch.cat([result(batch) for batch in batches]).numpy()
    made: dict[str, Any] = {"quantised_from": metadata.digest, "views": len(batches)}
    said = replace(
        metadata,
        name=f"{metadata.name}-int8",
        network=replace(metadata.network, architecture=INT8),
        training=metadata.training | {"int8": made},
        digest="",
    )
    return result, said, float(np.corrcoef(own, logit)[0, 1])


def _batch(detector: GraspDetector, view: LabelledView) -> BallBatch | None:
    x, y, z = map(float, view.camera_position)
    options = DetectOptions(
        viewpoint=(x, y, z), num_approach_points=APPROACH_POINTS, num_candidates=CANDIDATES
    )
    return cast(BallBatch | None, detector.prepare(view.points, options).batch)
