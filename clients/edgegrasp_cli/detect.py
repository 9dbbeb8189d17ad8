"""The commands that ask a detector, on a server or in this process: detect and models."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from edgegrasp_cli.flags import (
    CONNECTION,
    Server,
    Timeout,
    connect,
    option_flags,
    parse_option_flags,
    takes_flags,
)

Option = typer.Option
WEIGHTS_HELP = "Weights file or folder besides those that ship, where there is no server."


@takes_flags(connection=CONNECTION, options=option_flags())
def detect(
    file: Annotated[Path, typer.Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")],
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Annotated[list[Path] | None, Option(help=WEIGHTS_HELP)] = None,
    grippers: Annotated[
        list[Path] | None, Option(help="Gripper file (.toml), where there is no server.")
    ] = None,
    device: Annotated[
        str, Option(help="auto, cpu, cuda or cuda:N, where there is no server.")
    ] = "cpu",
    as_document: Annotated[bool, Option("--json", help="Print JSON, as the HTTP API.")] = False,
    options_file: Annotated[
        Path | None, Option("--options", help="JSON file with options; flags beside it win.")
    ] = None,
    *,
    connection: dict[str, Any],
    options: dict[str, Any],
) -> None:
    """Find grasps in a point cloud file, by a server or in this process.

    Options are written as in query parameters of the HTTP API: numbers, words, x,y,z, or JSON.
    """
    fields = _options(options_file, options)
    if server:
        with connect(server, timeout, **connection) as client:
            detection: Any = client.detect(file, **fields)
    else:
        detection = _detect_here(file, weights or [], grippers or [], device, fields)
    if as_document:
        print(json.dumps(_json_document(detection)))
    else:
        _print_detection(detection)


@takes_flags(connection=CONNECTION)
def models(
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Annotated[list[Path] | None, Option(help=WEIGHTS_HELP)] = None,
    *,
    connection: dict[str, Any],
) -> None:
    """List the weights that can be used, here or on a server."""
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "model", "architecture", "parameters", "crop radius (m)", "gripper", "device", "digest"
    )
    if server:
        with connect(server, timeout, **connection) as client:
            found = client.models()
    else:
        from edgegrasp_client import Model
        from edgegrasp_model.detector import ModelCatalogue

        facts = ModelCatalogue.load(weights or []).describe()
        found = [Model(**{name: row[name] for name in Model.__dataclass_fields__}) for row in facts]
    for row in found:
        table.add_row(
            f"{row.name} (default)" if row.default else row.name,
            row.architecture,
            f"{row.parameters:,}",
            f"{row.crop_radius:g}",
            row.gripper,
            row.device,
            row.digest[:12],
        )
    Console().print(table)


def _options(file: Path | None, given: dict[str, Any]) -> dict[str, Any]:
    """The options of the flags, and of the file where there is no flag."""
    try:
        fields = json.loads(file.read_text()) if file else {}
        if not isinstance(fields, dict):
            raise ValueError("a JSON object is needed")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    return fields | parse_option_flags(given)


def _detect_here(
    file: Path, weights: list[Path], grippers: list[Path], device: str, options: dict[str, Any]
) -> Any:
    from edgegrasp_model.options import parse_options
    from edgegrasp_service.worker.formats import read_file

    parsed = parse_options(options)
    cloud = read_file(file.suffix[1:].lower(), file.read_bytes(), max_points=sys.maxsize)

    from edgegrasp_model.detector import ModelCatalogue, choose_device

    catalogue = ModelCatalogue.load(weights, "", choose_device(device), grippers)
    return catalogue.get(parsed.model).detect(cloud, parsed)


def _json_document(detection: Any) -> dict[str, Any]:
    """The same document as the HTTP API's.

    Args:
        detection: From the detector or from the client; their fields have the same names.
    """
    grasps = [_plain(vars(grasp)) for grasp in detection.grasps]
    debug = None if detection.debug is None else _plain(vars(detection.debug))
    return dict(vars(detection)) | {"grasps": grasps, "debug": debug}


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """Arrays as lists, floats as float32, NaN as None."""
    plain = dict(fields)
    for name, value in fields.items():
        if isinstance(value, float):
            plain[name] = float(np.float32(value))
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            numbers = value.astype(np.float32).astype(object)
            numbers[np.isnan(value)] = None
            plain[name] = numbers.tolist()
        elif isinstance(value, np.ndarray):
            plain[name] = value.tolist()
    return plain


def _print_detection(detection: Any) -> None:
    """Print the ranked grasps, then counts and warnings."""
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "#", "score", "TCP x y z (m)", "approach direction", "width (m)", "clearance (m)", "free"
    )
    for rank, grasp in enumerate(detection.grasps, start=1):
        table.add_row(
            str(rank),
            f"{grasp.score:.3f}",
            _numbers(grasp.T_cloud_tcp[:3, 3]),
            _numbers(grasp.approach_direction),
            f"{grasp.width:.3f}",
            f"{grasp.clearance:+.3f}",
            "yes" if grasp.collision_free else "no",
        )
    console = Console()
    console.print(table)
    console.print(", ".join(f"{count} {name}" for name, count in detection.counts.items()))
    console.print(f"{detection.model}: {detection.seconds.get('total', 0.0):.2f} s")
    for warning in detection.warnings:
        console.print(f"Warning: {warning}")


def _numbers(vector: Any) -> str:
    return " ".join(f"{value:+.3f}" for value in vector)
