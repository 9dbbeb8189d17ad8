"""`edgegrasp quantise`."""

import sys
from pathlib import Path
from typing import Annotated

import typer


def quantise(
    weights: Annotated[Path, typer.Argument(help="Weights of an edgegrasp network.")],
    data: Annotated[list[Path], typer.Argument(help="Folders of views from generate-data.")],
    output: Annotated[
        Path | None, typer.Option(help="File to write; else NAME-int8.safetensors here.")
    ] = None,
) -> None:
    """Write weights in int8, several times as fast on a processor.

    The views say how large the network's features become; sixteen of them are looked at. Use the
    file like any other weights.
    """
    from edgegrasp_model.checkpoint import save_checkpoint
    from edgegrasp_model.detector import GraspDetector
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_training.quantisation import quantise_detector
    from edgegrasp_training.views import find_views

    try:
        detector = GraspDetector.load(weights)
        result, said, correlation = quantise_detector(detector, find_views(data))
    except (EdgeGraspError, ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp quantise: {error}")
    path = output or Path(f"{said.name}.safetensors")
    save_checkpoint(path, result, said)
    print(
        f"{path}: logits correlate {correlation:.4f} with {weights}, use it with --weights {path}"
    )
