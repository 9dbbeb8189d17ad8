"""The commands that ask a detector, on a server or in this process: detect and models."""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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

if TYPE_CHECKING:
    from edgegrasp_client import Model
    from edgegrasp_model.detector import ModelCatalogue

Option = typer.Option

Weights = Annotated[
    list[Path] | None,
    Option(help="Weights file or folder besides those that ship, where there is no server."),
]
Grippers = Annotated[
    list[Path] | None, Option(help="Gripper file (.toml), where there is no server.")
]
Device = Annotated[str, Option(help="auto, cpu, cuda or cuda:N, where there is no server.")]


@takes_flags(connection=CONNECTION, options=option_flags())
def detect(
    file: Annotated[Path, typer.Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")],
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Weights = None,
    grippers: Grippers = None,
    device: Device = "cpu",
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
    with open_client(server, timeout, connection, weights, grippers, device) as client:
        detection = client.detect(file, **fields)
    if as_document:
        print(json.dumps(_json_document(detection)))
    else:
        _print_detection(detection)


@takes_flags(connection=CONNECTION)
def models(
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Weights = None,
    *,
    connection: dict[str, Any],
) -> None:
    """List the weights that can be used, here or on a server."""
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "model", "architecture", "parameters", "crop radius (m)", "gripper", "device", "digest"
    )
    with open_client(server, timeout, connection, weights) as client:
        found = client.models()
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


def open_client(
    server: str | None,
    timeout: float,
    connection: Mapping[str, Any],
    weights: Sequence[Path] | None = None,
    grippers: Sequence[Path] | None = None,
    device: str = "cpu",
) -> AbstractContextManager[Any]:
    """A client of a server, or where there is none an OwnDetector.

    Args:
        server: Its address.
        timeout: Seconds to wait for it.
        connection: Keyword arguments of `connect`.
        weights: As for OwnDetector.
        grippers: As for OwnDetector.
        device: As for OwnDetector.
    """
    if server:
        return connect(server, timeout, **connection)
    return nullcontext(OwnDetector(weights or (), grippers or (), device))


class OwnDetector:
    """A detector in this process, asked as `GraspClient` asks a server.

    Args:
        weights: Files or folders besides those that ship.
        grippers: Gripper files that requests may name by their stem.
        device: Where the networks run, as of `choose_device`.
    """

    def __init__(self, weights: Sequence[Path], grippers: Sequence[Path], device: str) -> None:
        self._load = weights, grippers, device

    def detect(self, cloud: Any = None, *, depth_images: Any = None, **options: Any) -> Any:
        """Find grasps in a cloud: an array, a file, or depth images; raises as the detector."""
        from edgegrasp_client.clouds import depth_image_fields, npy_bytes
        from edgegrasp_model.options import parse_options
        from edgegrasp_service.worker.request_cloud import File, decode_cloud

        fields: dict[str, Any] = {}
        if depth_images is not None:
            images = enumerate(depth_images)
            fields["depth_images"] = [depth_image_fields(image, row) for row, image in images]
        elif isinstance(cloud, Path):
            fields["cloud"] = File(cloud.suffix[1:].lower(), cloud.read_bytes())
        else:
            fields["cloud"] = File("npy", npy_bytes(cloud))
        sent, parsed = decode_cloud(fields, parse_options(options), sys.maxsize)
        return self._catalogue.get(parsed.model).detect(sent, parsed)

    def models(self) -> "list[Model]":
        """The weights that can be used."""
        from edgegrasp_client import Model

        rows = self._catalogue.describe()
        return [Model(**{name: row[name] for name in Model.__dataclass_fields__}) for row in rows]

    @cached_property
    def _catalogue(self) -> "ModelCatalogue":
        from edgegrasp_model.detector import ModelCatalogue, choose_device

        weights, grippers, device = self._load
        return ModelCatalogue.load(weights, "", choose_device(device), grippers)


def _options(file: Path | None, given: dict[str, Any]) -> dict[str, Any]:
    """The options of the flags, and of the file where there is no flag."""
    try:
        fields = json.loads(file.read_text()) if file else {}
        if not isinstance(fields, dict):
            raise ValueError("a JSON object is needed")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    return fields | parse_option_flags(given)


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
