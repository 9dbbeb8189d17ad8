"""`edgegrasp mcp`: grasps for language-model agents, by the Model Context Protocol.

A client of a running server. An agent names files below one folder; answers are short enough for
its context, and `visualize_grasps` shows it a picture.
"""

import functools
import importlib.metadata
import io
import json
import re
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from edgegrasp_camera.depth import DepthView, fuse_depth_images, intrinsics_of
from edgegrasp_camera.errors import EdgeGraspError
from edgegrasp_camera.files import read_file
from edgegrasp_camera.poses import quaternion_from_matrix
from edgegrasp_cli.flags import CONNECTION, Timeout, connect, takes_flags

if TYPE_CHECKING:
    from mcp.server import MCPServer
    from mcp.server.mcpserver.tools.base import Tool

    from edgegrasp_client import Detection, GraspClient

MOST_GRASPS = 20  # in one answer: some 5,000 characters
BACK = 0.05  # metres from the pregrasp to the grasp
AROUND = 0.4  # metres around the objects that a picture shows
ABOVE = 0.6  # metres from the objects to the second picture's viewpoint
INSTRUCTIONS = (
    "Finds 6-DoF grasps of a parallel-jaw gripper in point clouds and depth images. Lengths are "
    "metres, quaternions xyzw; poses are in the frame of the cloud, that of a depth image in its "
    "camera's: x right, y down, z forward. Scores are probabilities that the grasp holds. To "
    "grasp: open to `width`, go to `pregrasp_hand_position` in the orientation of the grasp, go in "
    "straight, close. "
    "Read `warnings` before a robot moves."
)

Option = typer.Option


@takes_flags(connection=CONNECTION)
def mcp(
    server: Annotated[
        str, Option(help="The grasp server: host:port (gRPC) or http://host:port.")
    ] = "127.0.0.1:50051",
    timeout: Timeout = 60.0,
    folder: Annotated[Path, Option(help="Agents can name files below this folder.")] = Path(),
    http: Annotated[
        str | None, Option(help="HOST:PORT to serve HTTP at, under /mcp; else stdin and stdout.")
    ] = None,
    *,
    connection: dict[str, Any],
) -> None:
    """Serve grasps to language-model agents (Model Context Protocol).

    HTTP asks for no token: bind it to 127.0.0.1, or put a proxy that does in front of it.
    """
    if not folder.is_dir():
        raise ValueError(f"--folder: {folder} is no folder. Name one with clouds or images.")
    with connect(server, timeout, **connection) as client:
        tools = grasp_tools(client, folder.resolve())
        if http is None:
            tools.run()
        else:
            host, _, port = http.rpartition(":")
            tools.run("streamable-http", host=host or "127.0.0.1", port=int(port))


def grasp_tools(client: "GraspClient", folder: Path) -> "MCPServer":
    """The tools, to be run over a transport.

    Files are named relative to the folder; no file outside of it is read.
    """
    from mcp.server.mcpserver import Image, MCPServer
    from pydantic import Field

    inputs = _Inputs(client, folder)
    NumGrasps = Annotated[int, Field(ge=1, le=MOST_GRASPS)]
    Matrix = Annotated[
        list[list[float]], Field(description="4 x 4: camera to a base frame whose z is up, metres")
    ]

    def generate_grasps_from_point_cloud(
        point_cloud_file: str,
        num_grasps: NumGrasps = 5,
        viewpoint: list[float] | None = None,
        options: dict[str, Any] | None = None,
    ) -> str:
        """Grasps in a point cloud file (.npy, .npz, .ply, .pcd, .xyz), best first.

        `viewpoint` is the camera's position: give it if you know it.
        """
        asked = _asked(options, num_grasps, viewpoint)
        return _short(inputs.detect_in_file(point_cloud_file, asked))

    def generate_grasps_from_depth(
        depth_file: str,
        intrinsics: list[float],
        mask_file: str | None = None,
        depth_scale: float | None = None,
        T_base_camera: Matrix | None = None,
        num_grasps: NumGrasps = 5,
        options: dict[str, Any] | None = None,
    ) -> str:
        """Grasps in a depth image (.png of 16 bits, or .npy), best first.

        `intrinsics` are fx, fy, cx, cy in pixels. `mask_file` is an image of the same size that is
        not 0 on what is to be grasped, as a segmenter gives it. `depth_scale` is metres for one
        unit of the image (0.001 for whole numbers). With `T_base_camera` all that is asked and
        answered is in the base frame.
        """
        asked = _asked(options, num_grasps)
        camera = intrinsics, mask_file, depth_scale, T_base_camera
        return _short(inputs.detect_in_depth(depth_file, *camera, asked))

    def visualize_grasps(
        point_cloud_file: str | None = None,
        depth_file: str | None = None,
        intrinsics: list[float] | None = None,
        mask_file: str | None = None,
        depth_scale: float | None = None,
        T_base_camera: Matrix | None = None,
        num_grasps: NumGrasps = 5,
        viewpoint: list[float] | None = None,
        options: dict[str, Any] | None = None,
    ) -> list[str | Image]:
        """Two pictures of the grasps in a cloud file or a depth image: from the camera, from above.

        The best five carry their rank in the answer.

        Arguments are those of the tools that generate grasps; the same ones give the same grasps.
        """
        asked = _asked(options, num_grasps, viewpoint) | {"debug": True}
        if (point_cloud_file is None) == (depth_file is None):
            raise ValueError("Give point_cloud_file, or depth_file and intrinsics.")
        if point_cloud_file is not None:
            found = inputs.detect_in_file(point_cloud_file, asked)
        else:
            camera = intrinsics or [], mask_file, depth_scale, T_base_camera
            found = inputs.detect_in_depth(str(depth_file), *camera, asked)
        best = found.grasps[0].score if found.grasps else 0.0
        text = f"{len(found.grasps)} grasps, the best {best:.2f}. {' '.join(found.warnings)}"
        image = intrinsics, depth_scale, T_base_camera
        points, colors = inputs.shown(point_cloud_file, depth_file, *image)
        eye = np.zeros(3) if T_base_camera is None else np.asarray(T_base_camera)[:3, 3]
        eye = np.reshape(asked.get("viewpoint", eye), (-1, 3))[0]
        middle = np.median(found.debug.points, axis=0) if found.debug else eye
        above = middle + ABOVE * found.up + 1e-3
        drawn = [_picture(found, points, colors, place) for place in (eye, above)]
        return [text.strip(), *(Image(data=each, format="png") for each in drawn)]

    def edgegrasp_health_check() -> str:
        """Whether the grasp server is there and answers requests."""
        return "ready" if client.ready(timeout=5.0) else "not there, or still loading its weights"

    def edgegrasp_server_info() -> str:
        """The weights that the option `model` can name, and the gripper that each is for."""
        names = ("name", "architecture", "gripper", "default", "device")
        models = client.models()
        return json.dumps([{name: getattr(model, name) for name in names} for model in models])

    functions: list[Callable[..., Any]] = [
        generate_grasps_from_point_cloud,
        generate_grasps_from_depth,
        visualize_grasps,
        edgegrasp_health_check,
        edgegrasp_server_info,
    ]
    return MCPServer(
        "edgegrasp",
        instructions=INSTRUCTIONS,
        version=importlib.metadata.version("edgegrasp"),
        log_level="WARNING",
        tools=[_tool(function, folder) for function in functions],
    )


def _tool(function: Callable[..., Any], folder: Path) -> "Tool":
    """The tool, which refuses arguments that it does not have, and describes its options."""
    from mcp.server.mcpserver.tools.base import Tool

    # Compact text: as structured output the SDK would send it twice, once indented.
    tool = Tool.from_function(_with_sentences(function, folder), structured_output=False)
    arguments = tool.fn_metadata.arg_model
    arguments.model_config["extra"] = "forbid"
    arguments.model_rebuild(force=True)
    tool.parameters["additionalProperties"] = False
    if "options" in tool.parameters["properties"]:
        options, definitions = _schema_of_options()
        tool.parameters["properties"]["options"] = options
        tool.parameters["$defs"] = tool.parameters.get("$defs", {}) | definitions
    return tool


@functools.cache
def _schema_of_options() -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON Schema of options, without grippers as boxes, and what it refers to."""
    document = resources.files("edgegrasp.v1").joinpath("openapi.json").read_text()
    text = document.replace("#/components/schemas/", "#/$defs/")
    schemas = json.loads(text)["components"]["schemas"]
    options = schemas["DetectOptions"]
    options["properties"]["gripper"] = {"type": ["string", "null"], "description": "its name"}
    definitions: dict[str, Any] = {}
    todo = [options]
    while todo:
        for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(todo.pop())):
            if name not in definitions:
                definitions[name] = schemas[name]
                todo.append(schemas[name])
    return options, definitions


class _Inputs:
    """Files below a folder, sent to the server."""

    def __init__(self, client: "GraspClient", folder: Path) -> None:
        self._client, self._folder = client, folder

    def detect_in_file(self, name: str, options: dict[str, Any]) -> "Detection":
        return self._client.detect(self._path(name), **options)

    def detect_in_depth(
        self,
        name: str,
        intrinsics: list[float],
        mask: str | None,
        scale: float | None,
        T_base_camera: list[list[float]] | None,
        options: dict[str, Any],
    ) -> "Detection":
        from edgegrasp_client import DepthImage, on_mask

        if mask is not None:
            options = dict(on_mask(_pixels(self._path(mask)), options))
        image: DepthImage = {"depth": self._path(name), "intrinsics": intrinsics}
        if scale is not None:
            image["depth_scale"] = scale
        if T_base_camera is not None:
            image["T_cloud_camera"] = T_base_camera
            options = {"up": [0.0, 0.0, 1.0], **options}
        return self._client.detect(depth_images=[image], **options)

    def shown(
        self,
        cloud: str | None,
        depth: str | None,
        intrinsics: list[float] | None,
        scale: float | None,
        T_base_camera: list[list[float]] | None,
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Points (N, 3) and colours (N, 3), if there are any, to draw."""
        path = self._path(str(cloud or depth))
        if cloud is not None:
            sent = read_file(path.suffix[1:].lower(), path.read_bytes(), sys.maxsize)
        else:
            pose = np.eye(4) if T_base_camera is None else np.asarray(T_base_camera)
            view = DepthView(intrinsics_of(intrinsics), pose, scale)
            sent, _ = fuse_depth_images([_pixels(path)], [view])
        points, colors = (None if a is None else np.asarray(a) for a in (sent.points, sent.colors))
        assert points is not None
        return points.reshape(-1, 3), None if colors is None else colors.reshape(-1, 3)

    def _path(self, name: str) -> Path:
        path = (self._folder / name).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name} is not below the folder. Name a file below it.")
        if not path.is_file():  # a pipe would be waited for
            raise ValueError(f"{name} is no file.")
        return path


def _asked(
    options: dict[str, Any] | None, num_grasps: int, viewpoint: list[float] | None = None
) -> dict[str, Any]:
    """The options of a request: arguments of a tool of their own come first."""
    given = {"top_k": num_grasps}
    return {**(options or {}), **given, **({"viewpoint": viewpoint} if viewpoint else {})}


def _with_sentences(function: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    """The tool; what its caller can mend reaches the model as a sentence, without the folder."""
    from mcp.server.mcpserver.exceptions import ToolError

    from edgegrasp_client import GraspClientError

    @functools.wraps(function)
    def run(**arguments: Any) -> Any:
        try:
            return function(**arguments)
        except OSError as error:  # its own text has the whole path
            name = Path(str(error.filename or "")).name
            raise ToolError(f"{name}: {error.strerror}.") from error
        except (EdgeGraspError, GraspClientError, ValueError) as error:
            raise ToolError(str(error).replace(f"{folder}/", "")) from error

    return run


def _short(found: "Detection") -> str:
    """What an agent needs of a detection, as JSON in few digits."""
    grasps = [
        {
            "score": round(grasp.score, 3),
            "hand_position": _digits(grasp.T_cloud_hand[:3, 3], 4),
            "hand_quaternion_xyzw": _digits(quaternion_from_matrix(grasp.T_cloud_hand[:3, :3]), 4),
            "tcp_position": _digits(grasp.T_cloud_tcp[:3, 3], 4),
            "approach_direction": _digits(grasp.approach_direction, 3),
            "pregrasp_hand_position": _digits(grasp.pregrasp(BACK)[:3, 3], 4),
            "width": round(grasp.width, 4),
            "object": grasp.object,
        }
        for grasp in found.grasps
    ]
    objects = [
        {
            "number": thing.number,
            "center": _digits(thing.center, 3),
            "size": _digits(2 * thing.half_extents, 3),
            "confidence": None if thing.confidence is None else round(thing.confidence, 3),
            "best_score": None if thing.best_score is None else round(thing.best_score, 3),
            "reason": thing.reason,
        }
        for thing in found.objects[:MOST_GRASPS]
    ]
    up = _digits(found.up, 3)
    answer = {"grasps": grasps, "objects": objects, "up": up, "warnings": found.warnings}
    return json.dumps(answer if grasps else {**answer, "counts": found.counts})


def _digits(vector: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in vector]


def _pixels(path: Path) -> NDArray[Any]:
    from PIL import Image

    if path.suffix == ".npy":
        loaded: NDArray[Any] = np.load(path, allow_pickle=False)
        return loaded
    return np.asarray(Image.open(path))


def _picture(
    found: "Detection", points: NDArray[Any], colors: NDArray[Any] | None, eye: Any
) -> bytes:
    """The cloud near the grasps, and the grasps, as PNG."""
    from edgegrasp_sim.picture import Picture, View

    assert found.debug is not None
    near = np.linalg.norm(points - np.median(found.debug.points, axis=0), axis=1) < AROUND
    seen = points[near]
    if colors is not None:
        colors = np.multiply(colors[near], 255 if colors.dtype.kind == "f" else 1)
    file = io.BytesIO()
    title = f"{len(found.grasps)} grasps of {found.model}"
    picture = Picture(View.of(seen, eye, found.up), seen, colors, title=title)
    picture.grasps(found.grasps, (found.gripper.palm_z, found.gripper.tip_z))
    picture.save(file)
    return file.getvalue()
