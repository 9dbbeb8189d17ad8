"""Learning from the robot: recalibrate weights on the outcomes of executed grasps.

Fits two numbers, p = sigmoid(scale * logit + shift) (Platt scaling), which is as much as some
hundred outcomes can determine. The order of grasps stays the same.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import logit as logit_of

from edgegrasp_camera.arrays import Float64
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_training.evaluation import cross_entropy

SCORES = (1e-4, 1.0 - 1e-4)  # scores are taken to lie between
# Spread of log(scale) and of shift before there is any outcome: few outcomes change little.
PRIOR_SCALE, PRIOR_SHIFT = 0.5, 1.5
FEW = 25


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Executed grasps and whether they held."""

    logit: Float64  # (N,) of the score
    held: Float64  # (N,) 1 or 0


def read_outcomes(path: Path, digest: str = "") -> Outcomes:
    """The outcomes in a file of JSON lines: of the weights with this digest, or of all.

    Raises:
        ValueError: The file has none, or a line that is no outcome.
    """
    scores, held = [], []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            outcome = json.loads(line)
            if not digest or outcome["digest"] == digest:
                scores.append(float(outcome["score"]))
                held.append(float(outcome["held"]))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}, line {number}: {error!r}. It is no outcome.") from None
    if not scores:
        raise ValueError(
            f"{path}: no outcome of the weights {digest[:12]}. Name those that scored."
        )
    return Outcomes(logit_of(np.clip(scores, *SCORES)), np.array(held))


def fit(outcomes: Outcomes) -> tuple[float, float]:
    """Scale and shift of the logits that are most probable after the outcomes."""

    def cost(parameters: Float64) -> float:
        log_scale, shift = parameters
        prior = (log_scale / PRIOR_SCALE) ** 2 / 2 + (shift / PRIOR_SHIFT) ** 2 / 2
        logit = np.exp(log_scale) * outcomes.logit + shift
        return len(logit) * cross_entropy(logit, outcomes.held) + float(prior)

    log_scale, shift = minimize(cost, np.zeros(2)).x
    return float(np.exp(log_scale)), float(shift)


def recalibrate(weights: Path, outcomes_file: Path, folder: Path) -> str:
    """Write NAME-robot.safetensors, calibrated on outcomes; returns what was done."""
    network, metadata = load_checkpoint(weights)
    outcomes = read_outcomes(outcomes_file, metadata.digest)
    scale, shift = fit(outcomes)
    temperature = metadata.temperature / scale
    # sigmoid((logit + shift * temperature) / temperature): the shift goes into the last bias.
    last = [layer for layer in network.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.bias.add_(shift * temperature)
    held = float(outcomes.held.mean())
    learned: dict[str, Any] = {"outcomes": len(outcomes.held), "outcomes_held": round(held, 3)}
    old_scale, old_shift = metadata.training.get("outcomes_scale_shift", (1.0, 0.0))
    learned["outcomes_scale_shift"] = [scale * old_scale, scale * old_shift + shift]
    training = {**metadata.training, **learned, "recalibrated_from_digest": metadata.digest}
    name = f"{metadata.name}-robot"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.safetensors"
    new = replace(metadata, name=name, temperature=temperature, training=training)
    save_checkpoint(path, network, new)
    before = cross_entropy(outcomes.logit, outcomes.held)
    after = cross_entropy(scale * outcomes.logit + shift, outcomes.held)
    few = f" Warning: fewer than {FEW} outcomes say little." if len(outcomes.held) < FEW else ""
    return (
        f"{len(outcomes.held)} outcomes, {held:.2f} held: scores' cross entropy {before:.3f} -> "
        f"{after:.3f} (scale {scale:.2f}, shift {shift:+.2f}): {path}.{few}"
    )
