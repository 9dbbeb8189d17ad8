"""`edgegrasp detect`."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from edgegrasp_cli.connection import (
    FLAGS,
    TlsCa,
    TlsCertificate,
    TlsKey,
    TokenFile,
    UseTls,
    connect,
)
from edgegrasp_cli.detection_output import as_json, print_table

Option = typer.Option
NOT_OPTIONS = (
    *("file", "server", "timeout", *FLAGS, "weights", "grippers", "device"),
    *("as_document", "options"),
)


def detect(
    file: Annotated[Path, typer.Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")],
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else in this process.")
    ] = None,
    timeout: Annotated[float, Option(help="Seconds to wait for a server.")] = 60.0,
    token_file: TokenFile = None,
    tls: UseTls = False,
    tls_ca: TlsCa = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    weights: Annotated[
        list[Path] | None, Option(help="Weights file or folder, where there is no server.")
    ] = None,
    grippers: Annotated[
        list[Path] | None, Option(help="Gripper file (.toml), where there is no server.")
    ] = None,
    device: Annotated[
        str, Option(help="auto, cpu, cuda or cuda:N, where there is no server.")
    ] = "cpu",
    as_document: Annotated[bool, Option("--json", help="Print JSON, as the HTTP API.")] = False,
    options: Annotated[
        Path | None, Option(help="JSON file with options; those given beside it win.")
    ] = None,
    model: Annotated[str | None, Option(help="Weights to use.")] = None,
    gripper: Annotated[str | None, Option(help="Name of a gripper, or one as JSON.")] = None,
    num_approach_points: Annotated[int | None, Option(help="Approach points sampled.")] = None,
    num_candidates: Annotated[int | None, Option(help="Candidates scored at most.")] = None,
    sampling: Annotated[str | None, Option(help="farthest or uniform.")] = None,
    seed: Annotated[int | None, Option(help="Seed of every random choice.")] = None,
    viewpoint: Annotated[
        str | None, Option(help="Camera position, m: x,y,z; several as JSON.")
    ] = None,
    up: Annotated[str | None, Option(help="Direction away from gravity: x,y,z.")] = None,
    support: Annotated[
        str | None,
        Option(help='JSON: {"normal":[0,0,1],"offset":0} or {"kind":"ransac"}.'),
    ] = None,
    workspace: Annotated[str | None, Option(help='JSON: {"min":[0,0,0],"max":[1,1,1]}, m.')] = None,
    approach_region: Annotated[
        str | None,
        Option(help='JSON: {"include":[{"kind":"sphere","center":[0,0,0],"radius":0.1}]}.'),
    ] = None,
    contact_region: Annotated[str | None, Option(help="JSON, as --approach-region.")] = None,
    approach_direction: Annotated[
        str | None,
        Option(help='JSON: {"preset":"top-down"} or {"cones":[...]}, the way the hand moves.'),
    ] = None,
    collision: Annotated[
        str | None, Option(help='avoid, penalise, ignore, or JSON: {"margin":0.005}.')
    ] = None,
    min_score: Annotated[float | None, Option(help="Lowest score returned.")] = None,
    top_k: Annotated[int | None, Option(help="Grasps returned at most.")] = None,
    suppression: Annotated[
        str | None, Option(help='JSON: {"translation":0.01,"rotation":0.5}, m and rad; or null.')
    ] = None,
    order: Annotated[str | None, Option(help="score, highest or clearance.")] = None,
    debug: Annotated[
        bool | None, Option("--debug", help="Return every candidate; with --json.")
    ] = None,
) -> None:
    """Find grasps in a point cloud file, by a server or in this process.

    Options are written as in query parameters of the HTTP API.
    """
    given = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in locals().items()
        if name not in NOT_OPTIONS and value is not None
    }
    fields = _options(options, given)
    connection = (timeout, token_file, tls, tls_ca, tls_certificate, tls_key)
    if server:
        detection = _by_server(server, file, connection, fields)
    else:
        detection = _in_this_process(file, weights or [], grippers or [], device, fields)
    if as_document:
        print(json.dumps(as_json(detection)))
    else:
        print_table(detection)


def _options(file: Path | None, given: dict[str, str]) -> dict[str, Any]:
    """What the flags say, and the file where they do not."""
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_service.options_text import options_from_query

    try:
        fields = json.loads(file.read_text()) if file else {}
        if not isinstance(fields, dict):
            raise ValueError("a JSON object is needed")
        return fields | options_from_query(given.items())
    except (EdgeGraspError, OSError, ValueError) as error:
        sys.exit(f"edgegrasp detect: {file or 'options'}: {error}")


def _by_server(
    address: str, file: Path, connection: tuple[Any, ...], options: dict[str, Any]
) -> Any:
    from edgegrasp_client import GraspClientError

    try:
        with connect(address, *connection) as client:
            return client.detect(file, **options)
    except GraspClientError as error:
        sys.exit(f"edgegrasp detect: {error}")


def _in_this_process(
    file: Path, weights: list[Path], grippers: list[Path], device: str, options: dict[str, Any]
) -> Any:
    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_model.options import parse_options
    from edgegrasp_service.cloud_decoding import decode_file

    try:
        parsed = parse_options(options)
        data = file.read_bytes()
        cloud = decode_file(file.suffix[1:].lower(), data, max_points=sys.maxsize)

        from edgegrasp_model.detector import ModelCatalogue, choose_device

        catalogue = ModelCatalogue.load(weights, "", choose_device(device), grippers)
        return catalogue.get(parsed.model).detect(cloud, parsed)
    except (EdgeGraspError, OSError) as error:
        sys.exit(f"edgegrasp detect: {error}")
