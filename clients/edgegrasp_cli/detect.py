"""The commands `detect` and `models`, which use a server or a detector in this process."""

import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Column, Table
from typer import Argument, Option

from edgegrasp_camera.clouds import CloudInput
from edgegrasp_camera.files import pixels
from edgegrasp_camera.picture import draw_detection
from edgegrasp_cli.flags import ConnectionFlags, option_flags, parse_option_flags, takes_flags
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.request_cloud import File, decode_cloud, value_of_text
from edgegrasp_results import plain

if TYPE_CHECKING:
    from edgegrasp_client import DepthImage, Model
    from edgegrasp_model.detector import ModelCatalogue

PICTURES = (".png", ".jpg", ".jpeg")


class DetectorFlags(ConnectionFlags):
    """The flags that choose a server, or a detector in this process."""

    server: str | None = None
    """host:port (gRPC) or http://host:port; default: detect in this process"""
    weights: tuple[Path, ...] = ()
    """Weights file or folder, in addition to the built-in weights; only without --server"""
    grippers: tuple[Path, ...] = ()
    """Gripper file (.toml); only without --server"""
    device: str = "cpu"
    """auto, cpu, cuda or cuda:N; only without --server"""


class DetectFlags(DetectorFlags):
    """The flags of `edgegrasp detect` other than the options of the detection."""

    depth: tuple[Path, ...] = ()
    """Depth image instead of a cloud: 16-bit .png, or .npy; repeatable"""
    intrinsics: tuple[str, ...] = ()
    """Camera of --depth: fx,fy,cx,cy in pixels, or its 3 x 3 matrix as JSON"""
    pose: tuple[str, ...] = ()
    """Pose of the camera of each --depth in the cloud's frame: 4 x 4 matrix as JSON"""
    depth_scale: float | None = None
    """Metres per unit of --depth (0.001; for floats 1)"""
    color: Path | None = None
    """Colour image with the same pixels: .png or .npy"""
    mask: Path | None = None
    """Mask with the same pixels: grasp only where it is not 0; .png or .npy"""
    picture: Path | None = None
    """Picture of the best grasps to write, .png or .jpg"""
    robot: str | None = None
    """Name of a robot of the server; without --server: of a built-in robot, or a file"""
    joints: str | None = None
    """The robot's current joints: j1,j2,… in radians"""
    base: str | None = None
    """T_base_cloud: 16 numbers row by row, or the 4 x 4 matrix as JSON"""
    place: str | None = None
    """Where to put the object, base frame: {"region": {"min": …, "max": …}} or T_base_object"""
    avoid_unseen: bool = False
    """Whether the arm avoids the unseen space behind surfaces"""
    trajectory: Path | None = None
    """JSON file to write: the arm's motion for the best pick"""


@takes_flags(options=option_flags("robot", "previous"))
def detect(
    file: Annotated[
        Path | None, Argument(help="Cloud in metres: .npy, .npz, .ply, .pcd or .xyz.")
    ] = None,
    as_document: Annotated[bool, Option("--json", help="Print the HTTP API's JSON.")] = False,
    options_file: Annotated[
        Path | None, Option("--options", help="JSON file with options; flags override it.")
    ] = None,
    *,
    flags: DetectFlags,
    options: dict[str, Any],
) -> None:
    """Find grasps in a point cloud file or a depth image, on a server or in this process.

    Options have the form of the HTTP API's query parameters: numbers, words, x,y,z, or JSON.

    edgegrasp detect cloud.ply --viewpoint 0,0,0 --picture grasps.png

    edgegrasp detect --depth depth.png --intrinsics 615,615,320,240 --at 310,250

    edgegrasp detect cloud.ply --robot fr3 --joints 0,-0.8,0,-2.4,0,1.6,0.8 --base 1,0,0,0.3,…

    edgegrasp detect --depth a.png --depth b.png --intrinsics 615,615,320,240 --pose A --pose B
    """
    fields = _options(options_file, options) | _robot_option(flags)
    _check_outputs(flags, fields)
    images = _depth_images(file, flags)
    colors = None if flags.color is None else np.atleast_3d(pixels(flags.color))
    if colors is not None:  # (H, W, 3); a grey image gets three equal channels
        colors = colors[..., :3] if colors.shape[2] > 2 else colors[..., [0, 0, 0]]
    if flags.mask is not None:
        from edgegrasp_client import on_mask

        fields = dict(on_mask(pixels(flags.mask), fields))
    waiting = Console(stderr=True).status("Looking for grasps; the first run compiles loops…")
    with waiting, open_client(flags) as client:
        detection = client.detect(file, depth_images=images, colors=colors, **fields)
    if flags.picture is not None:
        sent, _ = decode_request(file, {"depth_images": images})
        draw_detection(flags.picture, detection, sent, fields, colors)
    if flags.trajectory is not None:
        _write_trajectory(flags.trajectory, detection)
    if as_document:
        text = json.dumps(detection, default=plain)
        print(json.dumps(json.loads(text, parse_constant=lambda _: None)))  # NaN is null
    else:
        _print_detection(detection)


@takes_flags()
def models(*, flags: DetectorFlags) -> None:
    """List the available weights, in this process or on a server."""
    names = (Column(name, no_wrap=True) for name in ("model", "architecture"))
    table = Table(*names, "parameters", "gripper", "device", box=box.SIMPLE)
    with Console(stderr=True).status("Loading weights…"), open_client(flags) as client:
        found = client.models()
    for row in found:
        name = f"{row.name} (default)" if row.default else row.name
        table.add_row(name, row.architecture, f"{row.parameters:,}", row.gripper, row.device)
    Console().print(table)


def open_client(flags: DetectorFlags) -> AbstractContextManager[Any]:
    """A client of a server, or an InProcessDetector if no server is given."""
    if flags.server:
        # benchmark-real needs --grippers too, to judge the server's grasps.
        alone = {"weights", "device"} | ({"grippers"} if isinstance(flags, DetectFlags) else set())
        for name in sorted(flags.model_fields_set & alone):
            raise ValueError(f"--{name}: got --server as well. Set it at the server.")
        return flags.connect(flags.server)
    robot = getattr(flags, "robot", None)
    return nullcontext(InProcessDetector(flags.weights, flags.grippers, flags.device, robot))


@dataclass(eq=False)
class InProcessDetector:
    """A detector in this process, with the interface of `GraspClient`."""

    weights: Sequence[Path] = ()
    grippers: Sequence[Path] = ()
    device: str = "cpu"
    robot: str | None = None  # a name or file, in place of the name in a request

    def detect(self, cloud: Any = None, **asked: Any) -> Any:
        """Find grasps like `GraspClient.detect`; also raises the errors of the detector."""
        sent, parsed = decode_request(cloud, asked)
        detector = self._catalogue.get(parsed.model)
        if parsed.robot is None:
            return detector.detect(sent, parsed)
        from edgegrasp_robot import load_robot, options_for_robot, plan_picks

        robot = load_robot(self.robot or parsed.robot.name)
        prepared = detector.prepare(sent, options_for_robot(parsed, robot))
        detection = detector.finish(prepared, detector.evaluate(prepared))
        return plan_picks(detection, prepared.scene, parsed, robot)

    def close(self) -> None:
        """Do nothing; there is no connection to close."""

    def models(self) -> "list[Model]":
        """The weights that are available."""
        from edgegrasp_client import Model

        return [Model(**facts) for facts in self._catalogue.describe()]

    @cached_property
    def _catalogue(self) -> "ModelCatalogue":
        from edgegrasp_model.detector import ModelCatalogue, choose_device

        return ModelCatalogue.load(self.weights, "", choose_device(self.device), self.grippers)


def decode_request(cloud: Any, asked: Mapping[str, Any]) -> tuple[CloudInput, DetectOptions]:
    """The cloud and the options of a request, decoded as on a server."""
    from edgegrasp_client.requests import Request, cloud_file

    request = Request(cloud, asked)
    fields: dict[str, Any] = {name: array.tobytes() for name, array in request.arrays.items()}
    if request.cloud is None:
        fields["depth_images"] = request.depth_images
    else:
        fields["cloud"] = File(*cloud_file(request.cloud))
    options = parse_options(request.options)
    return decode_cloud(fields, options, sys.maxsize), options


def _check_outputs(flags: DetectFlags, fields: Mapping[str, Any]) -> None:
    """Raise ValueError, before any work, if a picture or trajectory could not be written."""
    if flags.trajectory is not None and "robot" not in fields:
        raise ValueError("--trajectory: got no robot. Give --robot, --joints and --base.")
    for flag, file in (("--picture", flags.picture), ("--trajectory", flags.trajectory)):
        if file is not None and not file.absolute().parent.is_dir():
            raise ValueError(f"{flag}: there is no folder {file.parent}. Make it first.")
    if (path := flags.picture) is None:
        return
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"--picture: got {path.name!r}. Name a file {' or '.join(PICTURES)}.")
    importlib.import_module("matplotlib")  # fails before the work


def _options(file: Path | None, given: dict[str, Any]) -> dict[str, Any]:
    """The options from the flags, and from the file where no flag is given."""
    try:
        fields = json.loads(file.read_text("utf-8")) if file else {}
        if not isinstance(fields, dict):
            raise ValueError("a JSON object is needed")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    return fields | parse_option_flags(given)


def _robot_option(flags: DetectFlags) -> dict[str, Any]:
    """The option `robot` from the flags; empty if none of them is given."""
    given = {"--robot": flags.robot, "--joints": flags.joints, "--base": flags.base}
    missing = [flag for flag, value in given.items() if value is None]
    if len(missing) == len(given) and flags.place is None and not flags.avoid_unseen:
        return {}
    if missing:
        raise ValueError(f"{missing[0]}: got nothing. Give {', '.join(given)} together.")
    joints = value_of_text("--joints", str(flags.joints))
    joints = joints if isinstance(joints, list) else [joints]  # an arm with one joint
    pose = value_of_text("--base", str(flags.base))
    name = flags.robot if flags.server else Path(str(flags.robot)).stem  # a path may be long
    robot = {"name": name, "joints": joints, "T_base_cloud": pose}
    robot["avoid_unseen"] = flags.avoid_unseen
    if flags.place is not None:
        robot["place"] = value_of_text("--place", flags.place)
    return {"robot": robot}


def _write_trajectory(file: Path, detection: Any) -> None:
    """Write the best pick and its trajectory; raises ValueError if there is none."""
    best = detection.best_pick
    if best is None or best.arm.trajectory is None:
        raise ValueError(f"--trajectory: the arm reaches no grasp ({_counts(detection)}).")
    motion = {**vars(best.arm.trajectory), "T_cloud_hand": best.T_cloud_hand, "width": best.width}
    file.write_text(json.dumps(motion, default=np.ndarray.tolist))


def _depth_images(file: Path | None, flags: DetectFlags) -> "list[DepthImage] | None":
    """The images of --depth with their cameras; None if a cloud is given."""
    depths, intrinsics, poses = flags.depth, flags.intrinsics, flags.pose
    if (file is None) != bool(depths):
        raise ValueError("give a cloud file, or --depth and --intrinsics")
    if file is not None:
        of_image = {"intrinsics": intrinsics, "pose": poses, "depth-scale": flags.depth_scale}
        if beside := [flag for flag, value in of_image.items() if value]:
            raise ValueError(f"--{beside[0]}: got a cloud as well. Give --depth instead.")
        return None
    if not intrinsics:
        raise ValueError(f"--intrinsics: got nothing. Give fx,fy,cx,cy of {depths[0]}, in pixels.")
    intrinsics = intrinsics * len(depths) if len(intrinsics) == 1 else intrinsics
    each = f"one for each of {len(depths)} images."
    if len(intrinsics) != len(depths):
        raise ValueError(f"--intrinsics: got {len(intrinsics)}. Give one for all, or {each}")
    if len(poses) != len(depths) and (poses or len(depths) > 1):
        raise ValueError(f"--pose: got {len(poses)}. Give {each}")
    images: list[Any] = [{"depth": depth, "depth_scale": flags.depth_scale} for depth in depths]
    for image, camera, pose in zip_longest(images, intrinsics, poses):
        image["intrinsics"] = value_of_text("intrinsics", camera)
        if pose is not None:
            image["T_cloud_camera"] = value_of_text("pose", pose)
    return images


def _print_detection(detection: Any) -> None:
    """Print the ranked grasps, then counts and warnings."""
    names = "#", "score", "TCP x y z (m)", "approach x y z", "width (m)", "clearance (m)", "free"
    table = Table(*names, box=None, pad_edge=False, collapse_padding=True)  # in 80 columns
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
    console.print(_counts(detection))
    console.print(f"{detection.model}: {detection.seconds.get('total', 0.0):.2f} s")
    for warning in detection.warnings:
        console.print(f"Warning: {warning}")


def _numbers(vector: Any) -> str:
    return " ".join(f"{value:+.3f}" for value in vector)


def _counts(detection: Any) -> str:
    return ", ".join(f"{count} {name}" for name, count in detection.counts.items())
