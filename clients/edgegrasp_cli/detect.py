"""The commands that ask a detector, on a server or in this process: detect and models."""

import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from numpy.typing import NDArray

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
    from edgegrasp_client import DepthImage, Model
    from edgegrasp_model.detector import ModelCatalogue

Option = typer.Option
PICTURES = (".png", ".jpg", ".jpeg")
DRAWN = 10  # grasps in a picture
DRAWN_AROUND = 0.4  # metres from the grasps: what a picture of a cloud shows

Weights = Annotated[
    list[Path] | None,
    Option(help="Weights file or folder besides those that ship, where there is no server."),
]
Grippers = Annotated[
    list[Path] | None, Option(help="Gripper file (.toml), where there is no server.")
]
Cloud = Annotated[
    Path | None, typer.Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")
]
DepthScale = Annotated[
    float | None, Option(help="Metres for one unit of --depth (0.001; of floats 1).")
]
Color = Annotated[Path | None, Option(help="Colours of the same pixels: .png or .npy.")]
Device = Annotated[str, Option(help="auto, cpu, cuda or cuda:N, where there is no server.")]


@takes_flags(connection=CONNECTION, options=option_flags("robot"))
def detect(
    file: Cloud = None,
    depth: Annotated[
        list[Path] | None,
        Option(help="Depth image in place of a cloud: .png of 16 bits, or .npy. May be repeated."),
    ] = None,
    intrinsics: Annotated[
        list[str] | None,
        Option(help="Camera of --depth: fx,fy,cx,cy in pixels, or its 3 x 3 matrix as JSON."),
    ] = None,
    pose: Annotated[
        list[str] | None, Option(help="Camera of each --depth: 4 x 4 JSON, to the cloud's frame.")
    ] = None,
    depth_scale: DepthScale = None,
    color: Color = None,
    mask: Annotated[
        Path | None, Option(help="Grasp only where this is not 0: .png or .npy, same pixels.")
    ] = None,
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Weights = None,
    grippers: Grippers = None,
    device: Device = "cpu",
    picture: Annotated[
        Path | None, Option(help="Picture of the best grasps to write, .png or .jpg.")
    ] = None,
    robot: Annotated[
        str | None, Option(help="The server's robot of that name; else one that ships, or a file.")
    ] = None,
    joints: Annotated[
        str | None, Option(help="The robot's joints now: j1,j2,… in radians.")
    ] = None,
    base: Annotated[
        str | None,
        Option(help="T_base_cloud, its 16 numbers row by row, or the 4 x 4 matrix as JSON."),
    ] = None,
    trajectory: Annotated[
        Path | None, Option(help="JSON file to write the arm's motion to the best pick to.")
    ] = None,
    as_document: Annotated[bool, Option("--json", help="Print JSON, as the HTTP API.")] = False,
    options_file: Annotated[
        Path | None, Option("--options", help="JSON file with options; flags beside it win.")
    ] = None,
    *,
    connection: dict[str, Any],
    options: dict[str, Any],
) -> None:
    """Find grasps in a point cloud file or a depth image, by a server or in this process.

    Options are written as in query parameters of the HTTP API: numbers, words, x,y,z, or JSON.

    edgegrasp detect cloud.ply --viewpoint 0,0,0 --picture grasps.png

    edgegrasp detect --depth depth.png --intrinsics 615,615,320,240 --at 310,250

    edgegrasp detect cloud.ply --robot fr3 --joints 0,-0.8,0,-2.4,0,1.6,0.8 --base 1,0,0,0.3,…

    edgegrasp detect --depth a.png --depth b.png --intrinsics 615,615,320,240 --pose A --pose B
    """
    from rich.console import Console

    if picture is not None:
        _check_picture(picture)
    fields = _options(options_file, options) | _robot_option(robot, joints, base)
    if trajectory is not None and "robot" not in fields:
        raise ValueError("--trajectory: got no robot. Give --robot, --joints and --base.")
    images = _depth_images(file, depth or [], intrinsics or [], pose or [], depth_scale)
    colors = None if color is None else _pixels(color)[..., :3]
    if mask is not None:
        from edgegrasp_client import on_mask

        fields = dict(on_mask(_pixels(mask), fields))
    waiting = Console(stderr=True).status("Looking for grasps…")
    with waiting, open_client(server, timeout, connection, weights, grippers, device) as client:
        detection = client.detect(file, depth_images=images, colors=colors, **fields)
    if picture is not None:
        draw(picture, detection, fields, file, images, colors)
    if trajectory is not None:
        _write_trajectory(trajectory, detection)
    if as_document:
        from edgegrasp_service.worker.http_bodies import write

        print(write(detection).decode())
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
    from rich import box
    from rich.console import Console
    from rich.table import Column, Table

    name = Column("model", no_wrap=True)
    architecture = Column("architecture", no_wrap=True)
    table = Table(name, architecture, "parameters", "gripper", "device", box=box.SIMPLE)
    waiting = Console(stderr=True).status("Loading weights…")
    with waiting, open_client(server, timeout, connection, weights) as client:
        found = client.models()
    for row in found:
        table.add_row(
            f"{row.name} (default)" if row.default else row.name,
            row.architecture,
            f"{row.parameters:,}",
            row.gripper,
            row.device,
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
    """A client of a server, or where there is none an OwnDetector."""
    if server:
        return connect(server, timeout, **connection)
    return nullcontext(OwnDetector(weights or (), grippers or (), device))


class OwnDetector:
    """A detector in this process, asked as `GraspClient` asks a server."""

    def __init__(self, weights: Sequence[Path], grippers: Sequence[Path], device: str) -> None:
        self._load = weights, grippers, device

    def detect(
        self, cloud: Any = None, *, depth_images: Any = None, colors: Any = None, **options: Any
    ) -> Any:
        """Find grasps in a cloud: an array, a file, or depth images; raises as the detector."""
        sent, parsed = decode(cloud, depth_images, colors, options)
        detector = self._catalogue.get(parsed.model)
        if parsed.robot is None:
            return detector.detect(sent, parsed)
        from edgegrasp_robot import load_robot, plan_picks, with_robot

        robot = load_robot(parsed.robot.name)
        prepared = detector.prepare(sent, with_robot(parsed, robot))
        detection = detector.finish(prepared, detector.evaluate(prepared))
        return plan_picks(detection, prepared.scene, sent.points, parsed, robot)

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


def decode(cloud: Any, depth_images: Any, colors: Any, options: Mapping[str, Any]) -> Any:
    """What a server makes of a request: a CloudInput and DetectOptions; raises as it does."""
    from edgegrasp_client.clouds import depth_image_fields, npy_bytes
    from edgegrasp_model.options import parse_options
    from edgegrasp_model.request_cloud import File, decode_cloud

    fields: dict[str, Any] = {}
    if colors is not None:
        fields["colors"] = File("npy", npy_bytes(colors))
    if depth_images is not None:
        images = enumerate(depth_images)
        fields["depth_images"] = [depth_image_fields(image, row) for row, image in images]
    elif isinstance(cloud, Path):
        fields["cloud"] = File(cloud.suffix[1:].lower(), cloud.read_bytes())
    else:
        fields["cloud"] = File("npy", npy_bytes(cloud))
    return decode_cloud(fields, parse_options(options), sys.maxsize)


def draw(
    path: Path,
    detection: Any,
    options: Mapping[str, Any],
    cloud: Any = None,
    depth_images: "list[DepthImage] | None" = None,
    colors: NDArray[Any] | None = None,
) -> None:
    """Write a picture of a request and the best of its grasps.

    What is organised as a camera's image is drawn as that camera saw it, in its colours where they
    are given; another cloud from its viewpoint, or from above at a slant.

    The request is given as for `decode`.
    """
    import numpy as np

    from edgegrasp_sim.picture import Picture, View

    sent, parsed = decode(cloud, depth_images, colors, options)
    shape, points = np.shape(sent.points), np.reshape(sent.points, (-1, 3))
    shades = None if sent.colors is None else np.reshape(sent.colors, (-1, 3))
    if shades is not None and shades.dtype.kind == "f":
        shades = 255 * shades
    shown, image = detection.grasps[:DRAWN], None
    moved = any("T_cloud_camera" in each for each in depth_images or ())
    view = View.of_image(np.asarray(sent.points)) if len(shape) == 3 and not moved else None
    if view is not None:
        image = None if shades is None else shades.reshape(shape).astype(np.uint8)
    else:
        seen = points[np.isfinite(points).all(axis=1)]
        middle = np.median([grasp.T_cloud_tcp[:3, 3] for grasp in shown] or seen, axis=0)
        near = seen[np.linalg.norm(seen - middle, axis=1) < DRAWN_AROUND]
        up = np.asarray(detection.up, dtype=np.float64)
        aside = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        eye = np.ravel(parsed.viewpoint or middle + 0.6 * up - 0.5 * aside)[:3]
        view = View.of(near if len(near) else seen, eye, up)
    title = f"the {len(shown)} best of {len(detection.grasps)} grasps, {detection.model}"
    picture = Picture(view, points, shades, image, title)
    picture.regions(options)
    picture.grasps(shown, (detection.gripper.palm_z, detection.gripper.tip_z))
    picture.save(path)


def _check_picture(path: Path) -> None:
    """Raise ValueError, before any work, where a picture could not be written."""
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"--picture: got {path.name!r}. Name a file {' or '.join(PICTURES)}.")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"--picture: there is no folder {path.parent}. Make it first.")
    importlib.import_module("matplotlib")  # fails before the work, not after it


def _options(file: Path | None, given: dict[str, Any]) -> dict[str, Any]:
    """The options of the flags, and of the file where there is no flag."""
    try:
        fields = json.loads(file.read_text()) if file else {}
        if not isinstance(fields, dict):
            raise ValueError("a JSON object is needed")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    return fields | parse_option_flags(given)


def _robot_option(robot: str | None, joints: str | None, base: str | None) -> dict[str, Any]:
    """The option `robot` of the flags; nothing where there is none of them."""
    from edgegrasp_service.worker.http_bodies import value_of_text

    given = {"--robot": robot, "--joints": joints, "--base": base}
    missing = [flag for flag, value in given.items() if value is None]
    if len(missing) == len(given):
        return {}
    if missing:
        raise ValueError(f"{missing[0]}: got nothing. Give {', '.join(given)} together.")
    numbers = [part for part in str(joints).split(",") if part]
    pose = value_of_text("--base", str(base))
    return {"robot": {"name": robot, "joints": list(map(float, numbers)), "T_base_cloud": pose}}


def _write_trajectory(file: Path, detection: Any) -> None:
    """Write the motion to the best pick, and the pick; raises ValueError where there is none."""
    import numpy as np

    moving = [one for one in detection.grasps if one.arm is not None and one.arm.trajectory]
    if not moving:
        counts = ", ".join(f"{count} {name}" for name, count in detection.counts.items())
        raise ValueError(f"--trajectory: the arm has no way to any grasp ({counts}).")
    motion = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(moving[0].arm.trajectory).items()
    }
    motion |= {"T_cloud_hand": moving[0].T_cloud_hand.tolist(), "width": moving[0].width}
    file.write_text(json.dumps(motion))


def _depth_images(
    file: Path | None,
    depths: list[Path],
    intrinsics: list[str],
    poses: list[str],
    scale: float | None,
) -> "list[DepthImage] | None":
    """The images of --depth with their cameras; None where a cloud is given."""
    from edgegrasp_service.worker.http_bodies import value_of_text

    if (file is None) != bool(depths):
        raise ValueError("give a cloud file, or --depth and --intrinsics")
    if file is not None:
        return None
    if not intrinsics:
        raise ValueError(f"--intrinsics: got nothing. Give fx,fy,cx,cy of {depths[0]}, in pixels.")
    if len(intrinsics) == 1:
        intrinsics = intrinsics * len(depths)
    if len(depths) > 1 and not len(poses) == len(intrinsics) == len(depths):
        raise ValueError(f"--pose: got {len(poses)}. Give one for each of {len(depths)} images.")
    images: list[DepthImage] = []
    for depth, camera, pose in zip_longest(depths, intrinsics, poses[: len(depths)]):
        image: Any = {"depth": depth, "intrinsics": value_of_text("intrinsics", camera)}
        image |= {} if pose is None else {"T_cloud_camera": value_of_text("pose", pose)}
        image |= {} if scale is None else {"depth_scale": scale}
        images.append(image)
    return images


def _pixels(file: Path) -> NDArray[Any]:
    """The values of an image file: (H, W), or (H, W, C) of several channels."""
    from edgegrasp_model.request_cloud import File, decode_array

    return decode_array(str(file), File(file.suffix[1:].lower(), file.read_bytes()), sys.maxsize)


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
