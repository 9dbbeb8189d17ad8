"""The model card: where weights come from and how well they did on views they never saw."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE
from edgegrasp_model.networks.config import CheckpointMetadata, NetworkConfig
from edgegrasp_training.metrics import Evaluation, reliability

CURVE_ROWS = 20


def write_model_card(
    path: Path,
    metadata: CheckpointMetadata,
    training: Mapping[str, Any],
    evaluation: Evaluation,
    log: Path,
    command: str,
) -> None:
    """Write a card in Markdown.

    Args:
        path: File to write.
        metadata: Of the trained network.
        training: Provenance: views, labels, steps, seconds and the like.
        evaluation: On the validation views, before calibration.
        log: CSV file of the evaluations on the way.
        command: That trained it.
    """
    network = metadata.network
    rows = [
        ("architecture", network.architecture),
        ("crop radius", f"{network.crop_radius * 1000:g} mm"),
        *_layers(network),
        ("classifier", network.classifier_widths),
        ("voxel size", f"{metadata.voxel_size * 1000:g} mm"),
        ("gripper", metadata.gripper),
        *((name.replace("_", " "), value) for name, value in training.items()),
        ("validation loss", f"{evaluation.loss:.4f} nats"),
        ("validation accuracy", f"{100 * evaluation.accuracy:.1f} %"),
        ("validation AUROC", f"{evaluation.auroc:.4f}"),
        ("validation average precision", f"{evaluation.average_precision:.4f}"),
        ("temperature", f"{metadata.temperature:.3f}"),
    ]
    lines = [f"# {metadata.name}", "", "| | |", "| --- | --- |"]
    lines += [f"| {name} | {_cell(value)} |" for name, value in rows]
    lines += ["", "Trained by:", "", "```", command, "```", ""]
    lines += ["Reliability of the score on the validation views:", ""]
    lines += ["| score | held | grasps |", "| --- | --- | --- |"]
    calibrated = evaluation.logit / metadata.temperature
    lines += [
        f"| {predicted:.3f} | {observed:.3f} | {count} |"
        for predicted, observed, count in reliability(calibrated, evaluation.label)
    ]
    lines += ["", "On the way:", "", *_curve(log)]
    path.write_text("\n".join(lines) + "\n")


def _curve(log: Path) -> list[str]:
    """Some twenty rows of the log as a table, the last among them."""
    with log.open(newline="") as file:
        rows = list(csv.reader(file))
    head, body = [name.replace("_", " ") for name in rows[0]], rows[1:]
    every = max(1, len(body) // CURVE_ROWS)
    some = body[(len(body) - 1) % every :: every]
    return [f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *some]]


def _layers(network: NetworkConfig) -> list[tuple[str, object]]:
    """What comes before the classifier."""
    if network.architecture == "hand":
        return [
            ("hand description", f"{HAND_DESCRIPTION_SIZE} numbers per edge grasp"),
            ("point encoder", f"{network.hand_widths}, {network.hand_points} points of each hand"),
        ]
    return [
        ("neighbours", network.k),
        ("convolutions", network.conv_widths),
        ("global MLPs", f"{network.global_widths_1}, {network.global_widths_2}"),
    ]


def _cell(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
