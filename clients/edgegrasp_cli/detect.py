"""`edgegrasp detect`."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from edgegrasp_cli.detection_output import as_json, print_table

Option = typer.Option
Vector = tuple[float, float, float]


def detect(
    file: Annotated[Path, typer.Argument(help="Cloud in metres: .npy, .npz, .ply or .pcd.")],
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else in this process.")
    ] = None,
    timeout: Annotated[float, Option(help="Seconds to wait for a server.")] = 60.0,
    weights: Annotated[
        list[Path] | None, Option(help="Weights file or folder, where there is no server.")
    ] = None,
    as_document: Annotated[bool, Option("--json", help="Print JSON, as the HTTP API.")] = False,
    model: Annotated[str | None, Option(help="Weights to use.")] = None,
    num_approach_points: Annotated[int | None, Option(help="Approach points sampled.")] = None,
    num_candidates: Annotated[int | None, Option(help="Candidates scored at most.")] = None,
    sampling: Annotated[str | None, Option(help="farthest or uniform.")] = None,
    seed: Annotated[int | None, Option(help="Seed of the sampling.")] = None,
    viewpoint: Annotated[Vector | None, Option(help="Camera position, m.")] = None,
    up: Annotated[Vector | None, Option(help="Direction away from gravity.")] = None,
    support: Annotated[
        tuple[float, float, float, float] | None,
        Option(help="Plane objects rest on: unit normal, and normal . x of its points in m."),
    ] = None,
    workspace: Annotated[
        tuple[float, float, float, float, float, float] | None,
        Option(help="Box: lower corner, upper corner, m; points outside are dropped."),
    ] = None,
    collision: Annotated[str | None, Option(help="avoid, penalise or ignore.")] = None,
    min_score: Annotated[float | None, Option(help="Lowest score returned.")] = None,
    top_k: Annotated[int | None, Option(help="Grasps returned at most.")] = None,
    suppression: Annotated[
        tuple[float, float] | None,
        Option(help="Drop a grasp nearer than this to a better one: m and rad; 0 0: none."),
    ] = None,
) -> None:
    """Find grasps in a point cloud file, by a server or in this process."""
    scalars = {
        "model": model,
        "num_approach_points": num_approach_points,
        "num_candidates": num_candidates,
        "sampling": sampling,
        "seed": seed,
        "viewpoint": viewpoint,
        "up": up,
        "collision": collision,
        "min_score": min_score,
        "top_k": top_k,
    }
    options: dict[str, Any] = {name: value for name, value in scalars.items() if value is not None}
    if support is not None:
        options["support"] = {"normal": support[:3], "offset": support[3]}
    if workspace is not None:
        options["workspace"] = {"min": workspace[:3], "max": workspace[3:]}
    if suppression is not None:
        options["suppression"] = {"translation": suppression[0], "rotation": suppression[1]}
    if server:
        detection = _by_server(server, file, timeout, options)
    else:
        detection = _in_this_process(file, weights or [], options)
    if as_document:
        print(json.dumps(as_json(detection)))
    else:
        print_table(detection)


def _by_server(address: str, file: Path, timeout: float, options: dict[str, Any]) -> Any:
    from edgegrasp_client import GraspClient, GraspClientError

    try:
        with GraspClient(address, timeout=timeout) as client:
            return client.detect(file, **options)
    except GraspClientError as error:
        sys.exit(f"edgegrasp detect: {error}")


def _in_this_process(file: Path, weights: list[Path], options: dict[str, Any]) -> Any:
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_model.options import parse_options
    from edgegrasp_service.cloud_decoding import decode_file

    try:
        parsed = parse_options(options)
        data = file.read_bytes()
        cloud = decode_file(file.suffix[1:].lower(), data, max_points=sys.maxsize)

        from edgegrasp_model.catalogue import ModelCatalogue  # after what fails fast

        catalogue = ModelCatalogue.load(weights)
        return catalogue.get(parsed.model).detect(cloud, parsed)
    except (EdgeGraspError, OSError) as error:
        sys.exit(f"edgegrasp detect: {error}")
