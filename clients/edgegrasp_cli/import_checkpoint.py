"""`edgegrasp import-checkpoint`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

Option = typer.Option


def import_checkpoint(
    directory: Annotated[Path, typer.Argument(help="Holds the authors' *-ckpt-N.pt files.")],
    output: Annotated[
        Path | None, typer.Argument(help="File to write; else ARCHITECTURE.safetensors here.")
    ] = None,
    voxel_size: Annotated[float, Option(help="Of the clouds it was trained on, m.")] = 0.0045,
    crop_radius: Annotated[float, Option(help="Ball radius, m.")] = 0.05,
    gripper: Annotated[str, Option(help="Gripper it was trained for.")] = "panda",
) -> None:
    """Convert a checkpoint in the authors' layout to one safetensors file."""
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_model.gripper import load_gripper
    from edgegrasp_model.networks.checkpoint import save_checkpoint
    from edgegrasp_model.networks.import_checkpoint import import_checkpoint as convert

    try:
        load_gripper(gripper)
        network, metadata = convert(
            directory, voxel_size=voxel_size, crop_radius=crop_radius, gripper=gripper
        )
    except (EdgeGraspError, ValueError) as error:
        sys.exit(f"edgegrasp import-checkpoint: {error}")
    path = output or Path(f"{metadata.name}.safetensors")
    save_checkpoint(path, network, metadata)
    print(f"{path}: {metadata.network.architecture}, use it with --weights {path}")
