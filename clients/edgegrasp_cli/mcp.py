"""`edgegrasp mcp`: grasps for language-model agents, over the Model Context Protocol.

Runs as a client of a grasp server. An agent names files in one folder; answers are short enough for
its context, and `visualize_grasps` returns pictures.
"""

import functools
import importlib.metadata
import io
import json
import re
import signal
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field
from typer import Option

from edgegrasp_camera import EdgeGraspError
from edgegrasp_camera.files import pixels
from edgegrasp_camera.picture import draw_detection
from edgegrasp_cli.detect import decode_request
from edgegrasp_cli.flags import ServerFlags, takes_flags

if TYPE_CHECKING:
    from mcp.server import MCPServer
    from mcp.server.mcpserver.tools.base import Tool

    from edgegrasp_client import Detection, GraspClient
    from edgegrasp_results import ArmPlan

MAX_GRASPS = 20  # in one answer: about 5,000 characters
IDENTITY_POSE = [float(row == column) for row in range(4) for column in range(4)]  # T_base_cloud
INSTRUCTIONS = (
    "Finds 6-DoF grasps of a parallel-jaw gripper in point clouds and depth images. Lengths are "
    "metres, quaternions xyzw; poses are in the frame of the cloud, for a depth image in that of "
    "its camera: x right, y down, z forward. Scores are probabilities that the grasp holds. To "
    "grasp: open to `width`, go to `pregrasp_hand_position` in the orientation of the grasp, move "
    "straight to the grasp, close. With `robot`, an arm of `edgegrasp_server_info`, reachable "
    "grasps come first, each with `arm`: the joints at the grasp and the seconds of the motion. "
    "Read `warnings` before a robot moves."
)

NumGrasps = Annotated[int, Field(ge=1, le=MAX_GRASPS)]
Matrix = Annotated[
    list[list[float]], Field(description="4 x 4: camera to a base frame whose z is up, metres")
]

Arm = Annotated[
    dict[str, Any] | None, Field(description="the arm; T_base_cloud is the identity by default")
]


@takes_flags()
def mcp(
    folder: Annotated[Path, Option(help="Folder whose files agents may read.")] = Path(),
    http: Annotated[
        str | None, Option(help="HOST:PORT to serve /mcp at; default: stdin and stdout.")
    ] = None,
    *,
    flags: ServerFlags,
) -> None:
    """Serve grasps to language-model agents (Model Context Protocol).

    HTTP does not require a token: bind it to 127.0.0.1, or put an authenticating proxy in front of
    it.
    """
    if not folder.is_dir():
        raise ValueError(f"--folder: {folder} is not a folder. Name one with clouds or images.")
    host, _, port = (http or "0").rpartition(":")
    if not (port.isdecimal() and int(port) < 2**16):
        raise ValueError(f"--http: got {http!r}. Give HOST:PORT, such as 127.0.0.1:8090.")
    with flags.connect(flags.server) as client:
        tools = grasp_tools(client, folder.resolve())
        if http is None:
            # A thread that waits for standard input would prevent Python from exiting.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            tools.run()
        else:
            where = host.strip("[]") or "127.0.0.1"  # IPv6 is in brackets
            tools.run("streamable-http", host=where, port=int(port))


def grasp_tools(client: "GraspClient", folder: Path) -> "MCPServer":
    """The MCP server with its tools.

    File names are relative to the folder; no file outside of it is read.
    """
    from mcp.server.mcpserver import MCPServer

    tools = _Tools(client, folder)
    names = [name for name in vars(_Tools) if not name.startswith("_")]
    return MCPServer(
        "edgegrasp",
        instructions=INSTRUCTIONS,
        version=importlib.metadata.version("edgegrasp"),
        log_level="WARNING",
        tools=[_tool(getattr(tools, name), folder) for name in names],
    )


class _Tools:
    """The tools that an agent calls, each a method; it reads their docstrings and arguments."""

    def __init__(self, client: "GraspClient", folder: Path) -> None:
        self._client, self._folder = client, folder

    def generate_grasps_from_point_cloud(
        self,
        point_cloud_file: str,
        num_grasps: NumGrasps = 5,
        viewpoint: list[float] | None = None,
        robot: Arm = None,
        options: dict[str, Any] | None = None,
    ) -> str:
        """Grasps in a point cloud file (.npy, .npz, .ply, .pcd, .xyz), best first.

        `viewpoint` is the camera's position: give it if you know it.
        """
        asked = self._request(options, num_grasps, robot, viewpoint, point_cloud_file)
        return _short(self._client.detect(**asked), asked.get("collision"))

    def generate_grasps_from_depth(
        self,
        depth_file: str,
        intrinsics: list[float],
        mask_file: str | None = None,
        depth_scale: float | None = None,
        T_base_camera: Matrix | None = None,
        num_grasps: NumGrasps = 5,
        robot: Arm = None,
        options: dict[str, Any] | None = None,
    ) -> str:
        """Grasps in a depth image (.png of 16 bits, or .npy), best first.

        `intrinsics` are fx, fy, cx, cy in pixels. `mask_file` is an image of the same size, such as
        a segmentation, that is not 0 on the object to grasp. `depth_scale` is metres per unit of
        the image (0.001 for integers). With `T_base_camera`, the request and the answer are in the
        base frame.
        """
        image = (depth_file, intrinsics, mask_file, depth_scale, T_base_camera)
        asked = self._request(options, num_grasps, robot, image=image)
        return _short(self._client.detect(**asked), asked.get("collision"))

    def visualize_grasps(
        self,
        point_cloud_file: str | None = None,
        depth_file: str | None = None,
        intrinsics: list[float] | None = None,
        mask_file: str | None = None,
        depth_scale: float | None = None,
        T_base_camera: Matrix | None = None,
        num_grasps: NumGrasps = 5,
        viewpoint: list[float] | None = None,
        robot: Arm = None,
        options: dict[str, Any] | None = None,
    ) -> list[Any]:
        """Two pictures of the grasps in a cloud file or a depth image: from the camera, from above.

        The best five are labelled with their rank in the answer.

        The arguments, and the grasps for them, are those of the tools that generate grasps.
        """
        from mcp.server.mcpserver import Image

        image = (depth_file, intrinsics, mask_file, depth_scale, T_base_camera)
        given = depth_file is None and any(part is not None for part in image)
        if (point_cloud_file is None) == (depth_file is None) or given:
            raise ValueError("Give point_cloud_file alone, or depth_file and intrinsics.")
        asked = self._request(options, num_grasps, robot, viewpoint, point_cloud_file, image)
        found = self._client.detect(**asked)
        sent, _ = decode_request(asked.get("cloud"), {"depth_images": asked.get("depth_images")})
        best = found.grasps[0].score if found.grasps else 0.0
        text = f"{len(found.grasps)} grasps, the best {best:.2f}. {' '.join(found.warnings)}"
        pictures = []
        for from_above in (False, True):
            drawn = io.BytesIO()
            draw_detection(drawn, found, sent, asked, from_above=from_above)
            pictures.append(Image(data=drawn.getvalue(), format="png"))
        return [text.strip(), *pictures]

    def edgegrasp_health_check(self) -> str:
        """Whether the grasp server is reachable and answers requests."""
        ready = self._client.ready(timeout=5.0)
        return "ready" if ready else "unreachable, or still loading its weights"

    def edgegrasp_server_info(self) -> str:
        """The weights that the option `model` can name, the robots, and the gripper of each."""
        facts = ("name", "architecture", "gripper", "default", "device")
        models = [{name: getattr(one, name) for name in facts} for one in self._client.models()]
        of_arm = ("name", "gripper", "base_frame", "joint_names")
        robots = [
            {name: getattr(one, name) for name in of_arm} | {"home": _digits(one.home, 4)}
            for one in self._client.robots()
        ]
        return json.dumps({"models": models, "robots": robots})

    def _request(
        self,
        options: dict[str, Any] | None,
        num_grasps: int,
        robot: dict[str, Any] | None,
        viewpoint: list[float] | None = None,
        cloud_file: str | None = None,
        image: tuple[Any, ...] = (),  # in place of a cloud: file, intrinsics, mask, scale, pose
    ) -> dict[str, Any]:
        """The arguments of `GraspClient.detect`; a tool's arguments override its options."""
        from edgegrasp_client.requests import on_mask, plain_options

        if "top_k" in (options or {}):
            raise ValueError("options.top_k: got num_grasps as well. Give only num_grasps.")
        asked = plain_options(options or {}) | {"top_k": num_grasps}
        if viewpoint:
            asked["viewpoint"] = viewpoint
        if robot:
            asked["robot"] = {"T_base_cloud": IDENTITY_POSE, **robot}
        if cloud_file is not None:
            return asked | {"cloud": self._path(cloud_file)}
        depth_file, intrinsics, mask_file, scale, pose = image
        view = {"depth": self._path(depth_file), "intrinsics": intrinsics, "depth_scale": scale}
        if pose is not None:
            asked, view["T_cloud_camera"] = {"up": [0.0, 0.0, 1.0], **asked}, pose
        elif (asked.get("robot") or {}).get("T_base_cloud") is IDENTITY_POSE:
            raise ValueError("robot: give T_base_camera, in the arm's base frame.")
        if mask_file is not None:
            asked = dict(on_mask(pixels(self._path(mask_file)), asked))
        return asked | {"depth_images": [view]}

    def _path(self, name: str) -> Path:
        path = (self._folder / name).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name} is not below the folder. Name a file below it.")
        if not path.is_file():  # reading a pipe would block
            raise ValueError(f"{name} is not a file.")
        return path


def _tool(function: Callable[..., Any], folder: Path) -> "Tool":
    """The tool of a function; it refuses unknown arguments and has a schema of its options."""
    from mcp.server.mcpserver.tools.base import Tool

    # Compact text, since the SDK would send structured output twice, once indented.
    tool = Tool.from_function(_with_sentences(function, folder), structured_output=False)
    arguments = tool.fn_metadata.arg_model
    arguments.model_config["extra"] = "forbid"
    arguments.model_rebuild(force=True)
    tool.parameters["additionalProperties"] = False
    if "options" in tool.parameters["properties"]:
        options, definitions = _schema_of_options()
        tool.parameters["properties"]["options"] = options
        arm = {"anyOf": [{"$ref": "#/$defs/RobotArm"}, {"type": "null"}], "default": None}
        tool.parameters["properties"]["robot"] |= arm
        tool.parameters["$defs"] = tool.parameters.get("$defs", {}) | definitions
    return tool


@functools.cache
def _schema_of_options() -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON Schema of options, without grippers as boxes, and the definitions it uses."""
    document = resources.files("edgegrasp.v1").joinpath("openapi.json").read_text("utf-8")
    schemas = json.loads(document.replace("#/components/schemas/", "#/$defs/"))
    schemas = schemas["components"]["schemas"]
    options = schemas["DetectOptions"]
    options["properties"]["gripper"] = {"type": ["string", "null"], "description": "its name"}
    names = ["DetectOptions"]
    for name in names:  # grows by the definitions that each one uses
        named = dict.fromkeys(re.findall(r'"#/\$defs/(\w+)"', json.dumps(schemas[name])))
        names += [one for one in named if one not in names]
    definitions = {name: schemas[name] for name in names[1:]}
    del options["properties"]["robot"], options["properties"]["top_k"]  # arguments of their own
    definitions["RobotArm"]["required"].remove("T_base_cloud")
    return options, definitions


def _with_sentences(function: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    """Wrap a tool so that the agent gets errors that it can fix, without the folder's path."""
    from mcp.server.mcpserver.exceptions import ToolError

    from edgegrasp_client import GraspClientError

    @functools.wraps(function)
    def run(**arguments: Any) -> Any:
        try:
            return function(**arguments)
        except (EdgeGraspError, GraspClientError, OSError, RuntimeError, ValueError) as error:
            raise ToolError(str(error).replace(f"{folder}/", "")) from error

    return run


def _short(found: "Detection", collision: Any) -> str:
    """The part of a detection that an agent needs, as JSON with few digits."""
    from edgegrasp_client.conversions import quaternion_from_matrix

    back = collision.get("approach_length", 0.05) if isinstance(collision, dict) else 0.05
    grasps = [
        {
            "score": round(grasp.score, 3),
            "hand_position": _digits(grasp.T_cloud_hand[:3, 3], 4),
            "hand_quaternion_xyzw": _digits(quaternion_from_matrix(grasp.T_cloud_hand[:3, :3]), 4),
            "tcp_position": _digits(grasp.T_cloud_tcp[:3, 3], 4),
            "approach_direction": _digits(grasp.approach_direction, 3),
            "pregrasp_hand_position": _digits(grasp.pregrasp(back)[:3, 3], 4),
            "width": round(grasp.width, 4),
            "object": grasp.object,
            **({} if grasp.arm is None else {"arm": _short_plan(grasp.arm)}),
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
        for thing in found.objects[:MAX_GRASPS]
    ]
    up = _digits(found.up, 3)
    answer = {"grasps": grasps, "objects": objects, "up": up, "warnings": found.warnings}
    if not grasps or (found.grasps[0].arm and not found.best_pick):
        answer["counts"] = found.counts
    return json.dumps(answer)


def _short_plan(plan: "ArmPlan") -> dict[str, Any]:
    """The joints at each stop of an arm, and the duration of its motion."""
    found: dict[str, Any] = {"reachable": plan.reachable}
    for name in ("pregrasp_joints", "grasp_joints", "place_joints"):
        if (joints := getattr(plan, name)) is not None:
            found[name] = _digits(joints, 4)
    if plan.trajectory is not None:
        found["seconds"] = round(float(plan.trajectory.times[-1]), 2)
    return found


def _digits(vector: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in vector]
