"""`edgegrasp mcp`: grasps for language-model agents, by the Model Context Protocol.

A client of a running server. An agent names files below one folder; answers are short enough for
its context, and `visualize_grasps` shows it a picture.
"""

import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from edgegrasp_cli.flags import CONNECTION, Timeout, connect, takes_flags

if TYPE_CHECKING:
    from mcp.server import MCPServer

    from edgegrasp_client import Detection, GraspClient

MOST_GRASPS = 20  # in one answer: some 5,000 characters
INSTRUCTIONS = (
    "Finds 6-DoF grasps of a parallel-jaw gripper in point clouds and depth images. Lengths are "
    "metres, quaternions xyzw; poses are in the frame of the cloud, that of a depth image in its "
    "camera's: x right, y down, z forward. Scores are probabilities that the grasp holds. To "
    "grasp: open to `width`, stand 0.05 m back along `approach_direction`, go in straight, close. "
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

    from edgegrasp_client.options import DetectOptions

    server = MCPServer("edgegrasp", instructions=INSTRUCTIONS, log_level="WARNING")
    inputs = _Inputs(client, folder)
    options_text = f"`options` has any of: {', '.join(DetectOptions.__annotations__)}."

    def tool(function: Callable[..., Any]) -> None:
        description = f"{function.__doc__} {options_text if 'grasps' in function.__name__ else ''}"
        # Compact text: as structured output the SDK would send it twice, once indented.
        server.tool(description=description.strip(), structured_output=False)(
            _with_sentences(function)
        )

    def generate_grasps_from_point_cloud(
        point_cloud_file: str,
        num_grasps: int = 5,
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
        num_grasps: int = 5,
        options: dict[str, Any] | None = None,
    ) -> str:
        """Grasps in a depth image (.png of 16 bits, or .npy), best first.

        `intrinsics` are fx, fy, cx, cy in pixels. `mask_file` is an image of the same size that is
        not 0 on what is to be grasped, as a segmenter gives it. `depth_scale` is metres for one
        unit of the image (0.001 for whole numbers).
        """
        asked = _asked(options, num_grasps)
        return _short(inputs.detect_in_depth(depth_file, intrinsics, mask_file, depth_scale, asked))

    def visualize_grasps(
        point_cloud_file: str | None = None,
        depth_file: str | None = None,
        intrinsics: list[float] | None = None,
        mask_file: str | None = None,
        depth_scale: float | None = None,
        num_grasps: int = 5,
        viewpoint: list[float] | None = None,
        options: dict[str, Any] | None = None,
    ) -> list[str | Image]:
        """A picture of the grasps in a point cloud file or a depth image, from two sides.

        Arguments are those of the tools that generate grasps; the same ones give the same grasps.
        """
        asked = _asked(options, num_grasps, viewpoint) | {"debug": True}
        if (point_cloud_file is None) == (depth_file is None):
            raise ValueError("Give point_cloud_file, or depth_file and intrinsics.")
        if point_cloud_file is not None:
            found = inputs.detect_in_file(point_cloud_file, asked)
        else:
            found = inputs.detect_in_depth(
                str(depth_file), intrinsics or [], mask_file, depth_scale, asked
            )
        best = found.grasps[0].score if found.grasps else 0.0
        text = f"{len(found.grasps)} grasps, the best {best:.2f}. {' '.join(found.warnings)}"
        return [text.strip(), Image(data=_picture(found, asked.get("viewpoint")), format="png")]

    def edgegrasp_health_check() -> str:
        """Whether the grasp server is there and answers requests."""
        return "ready" if client.ready(timeout=5.0) else "not there, or still loading its weights"

    def edgegrasp_server_info() -> str:
        """The weights that the option `model` can name, and the gripper that each is for."""
        names = ("name", "architecture", "gripper", "default", "device")
        models = client.models()
        return json.dumps([{name: getattr(model, name) for name in names} for model in models])

    for function in (
        generate_grasps_from_point_cloud,
        generate_grasps_from_depth,
        visualize_grasps,
        edgegrasp_health_check,
        edgegrasp_server_info,
    ):
        tool(function)
    return server


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
        options: dict[str, Any],
    ) -> "Detection":
        from edgegrasp_client import DepthImage, on_mask

        if mask is not None:
            options = dict(on_mask(_pixels(self._path(mask)), options))
        image: DepthImage = {"depth": self._path(name), "intrinsics": intrinsics}
        if scale is not None:
            image["depth_scale"] = scale
        return self._client.detect(depth_images=[image], **options)

    def _path(self, name: str) -> Path:
        path = (self._folder / name).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name} is not below {self._folder}. Name a file below it.")
        return path


def _asked(
    options: dict[str, Any] | None, num_grasps: int, viewpoint: list[float] | None = None
) -> dict[str, Any]:
    """The options of a request: arguments of a tool of their own come first."""
    given = {"top_k": min(max(num_grasps, 1), MOST_GRASPS)}
    return {**(options or {}), **given, **({"viewpoint": viewpoint} if viewpoint else {})}


def _with_sentences(function: Callable[..., Any]) -> Callable[..., Any]:
    """The tool; what its caller can mend reaches the model as a sentence."""
    from mcp.server.mcpserver.exceptions import ToolError

    from edgegrasp_client import GraspClientError

    @functools.wraps(function)
    def run(**arguments: Any) -> Any:
        try:
            return function(**arguments)
        except (GraspClientError, OSError, ValueError) as error:
            raise ToolError(str(error)) from error

    return run


def _short(found: "Detection") -> str:
    """What an agent needs of a detection, as JSON in few digits."""
    from edgegrasp_client.conversions import quaternion_from_matrix

    grasps = [
        {
            "score": round(grasp.score, 3),
            "hand_position": _digits(grasp.T_cloud_hand[:3, 3], 4),
            "hand_quaternion_xyzw": _digits(quaternion_from_matrix(grasp.T_cloud_hand[:3, :3]), 4),
            "tcp_position": _digits(grasp.T_cloud_tcp[:3, 3], 4),
            "approach_direction": _digits(grasp.approach_direction, 3),
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
            "best_score": None if thing.best_score is None else round(thing.best_score, 3),
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


def _picture(found: "Detection", viewpoint: Any) -> bytes:
    """The processed cloud and the grasps as PNG, turned so that up is up."""
    from dataclasses import replace

    from edgegrasp_sim.picture import draw_grasps

    assert found.debug is not None
    z = found.up.astype(np.float64)
    y = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    y /= np.linalg.norm(y)
    T_level_cloud = np.eye(4)
    T_level_cloud[:3, :3] = [np.cross(y, z), y, z]
    turn = T_level_cloud[:3, :3].T
    grasps = [
        replace(each, T_cloud_hand=(T_level_cloud @ each.T_cloud_hand).astype(np.float32))
        for each in found.grasps
    ]
    eye = np.zeros(3) if viewpoint is None else np.reshape(viewpoint, (-1, 3))[0]
    file = io.BytesIO()
    title = f"{len(grasps)} grasps of {found.model}; axes turned so that z is up"
    hand = found.gripper.palm_z, found.gripper.tip_z
    draw_grasps(
        file,
        found.debug.points @ turn,
        grasps,
        camera_position=eye @ turn,
        title=title,
        palm_and_tip=hand,
    )
    return file.getvalue()
