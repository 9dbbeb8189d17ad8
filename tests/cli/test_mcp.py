"""The tools as an agent has them: mcp's own client, over stdio and over HTTP."""

import importlib.metadata
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from tests.cli.commands import refused
from tests.programs import EDGEGRASP, free_ports, run, started, until

from edgegrasp_cli.mcp import grasp_tools
from edgegrasp_client import Detection, GraspClient
from edgegrasp_results import ArmPlan, ArmTrajectory

mcp = pytest.importorskip("mcp", reason="the extra `mcp` is not installed")
image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")

PROGRAM = [*EDGEGRASP[1:], "mcp"]
CAMERA = [60.0, 60.0, 15.5, 11.5]
IMAGE = {"depth_file": "depth.png", "intrinsics": CAMERA}
CLOUD, DEPTH = "generate_grasps_from_point_cloud", "generate_grasps_from_depth"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "camera"
    folder.mkdir()
    depth = np.random.default_rng(0).integers(500, 600, (24, 32)).astype(np.uint16)
    mask = np.zeros((24, 32), np.uint8)
    mask[4:12, 8:20] = 255
    image.fromarray(depth).save(folder / "depth.png")
    image.fromarray(mask).save(folder / "mask.png")
    (folder / "loop.npy").symlink_to("loop.npy")
    os.mkfifo(folder / "pipe.npy")  # nobody writes to it: who opens it waits for ever
    np.save(folder / "cloud.npy", np.random.default_rng(1).uniform(0, 0.2, (500, 3)))
    np.save(tmp_path / "outside.npy", np.zeros((9, 3)))
    return folder


@asynccontextmanager
async def agent(address: str, folder: Path) -> AsyncIterator[Any]:
    """A client of the tools, in this process."""
    with GraspClient(address) as client:
        async with mcp.Client(grasp_tools(client, folder)) as agent:
            yield agent


def answer(result: Any) -> Any:
    assert not result.is_error, result.content
    return json.loads(result.content[0].text)


async def test_an_agent_gets_grasps_and_sees_them(dummy_server, folder: Path) -> None:
    words = [*PROGRAM, "--server", dummy_server.grpc_address, "--folder", str(folder)]
    program = mcp.StdioServerParameters(command=sys.executable, args=words, env=dict(os.environ))
    async with mcp.Client(program, read_timeout_seconds=120) as client:
        tools = {tool.name: tool for tool in (await client.list_tools()).tools}
        others = {"visualize_grasps", "edgegrasp_health_check", "edgegrasp_server_info"}
        assert set(tools) == {CLOUD, DEPTH} | others
        schema = tools[DEPTH].input_schema
        options = schema["properties"]["options"]["properties"]
        assert {"objects", "near", "workspace"} <= set(options)
        jsonschema.Draft202012Validator.check_schema(schema)
        validator = jsonschema.Draft202012Validator(schema)
        validator.validate(IMAGE | {"options": {"workspace": {"min": [0, 0, 0], "max": [1, 1, 1]}}})
        wrong_options = ({"options": {"workspace": 3}}, {"options": {"top_k": 1}})
        for wrong in ({"object": "bottle"}, *wrong_options, {"num_grasps": -3}):
            assert not validator.is_valid(IMAGE | wrong)
        assert client.server_info.version == importlib.metadata.version("edgegrasp")
        assert (await client.call_tool("edgegrasp_health_check", {})).content[0].text == "ready"
        info = answer(await client.call_tool("edgegrasp_server_info", {}))
        assert [model["name"] for model in info["models"]] == ["dummy"]
        assert info["robots"] == []

        asked = {"point_cloud_file": "cloud.npy", "num_grasps": 3, "options": {"seed": 7}}
        found = answer(await client.call_tool(CLOUD, asked))
        assert found == answer(await client.call_tool(CLOUD, asked))
        assert len(found["grasps"]) == 3
        grasp = found["grasps"][0]
        assert np.linalg.norm(grasp["hand_quaternion_xyzw"]) == pytest.approx(1, abs=1e-3)
        tcp = np.subtract(grasp["tcp_position"], grasp["hand_position"])
        assert tcp @ grasp["approach_direction"] == pytest.approx(0.1, abs=1e-3)
        way = np.subtract(grasp["hand_position"], grasp["pregrasp_hand_position"])
        np.testing.assert_allclose(way, 0.05 * np.array(grasp["approach_direction"]), atol=2e-4)
        short = {**asked, "options": {"collision": {"approach_length": 0.02}}}
        grasp = answer(await client.call_tool(CLOUD, short))["grasps"][0]
        way = np.subtract(grasp["hand_position"], grasp["pregrasp_hand_position"])
        assert np.linalg.norm(way) == pytest.approx(0.02, abs=2e-4)

        shown = await client.call_tool("visualize_grasps", asked)
        assert shown.content[0].text.startswith("3 grasps, the best ")
        assert [part.mime_type for part in shown.content[1:]] == ["image/png", "image/png"]
        assert shown.content[1].data != shown.content[2].data


async def test_a_camera_pose_puts_answers_into_the_base_frame(dummy_server, folder: Path) -> None:
    T_base_camera = np.array([[0, -1, 0, 0.4], [-1, 0, 0, 0.1], [0, 0, -1, 0.9], [0, 0, 0, 1]])
    asked = IMAGE | {"T_base_camera": T_base_camera.tolist()}
    depth = np.asarray(image.open(folder / "depth.png"))
    view = {"depth": depth, "intrinsics": CAMERA, "T_cloud_camera": T_base_camera}
    with GraspClient(dummy_server.grpc_address) as client:
        expected = client.detect(depth_images=[view], top_k=5).grasps
    async with agent(dummy_server.grpc_address, folder) as client:
        found = answer(await client.call_tool(DEPTH, asked))
    for grasp, wanted in zip(found["grasps"], expected, strict=True):
        np.testing.assert_allclose(grasp["tcp_position"], wanted.T_cloud_tcp[:3, 3], atol=1e-4)


def test_no_folder_and_an_address_without_a_port_are_named() -> None:
    done = run(sys.executable, *PROGRAM, "--folder", "/nonexistent", code=1)
    assert "/nonexistent is not a folder" in done.stderr
    for http in ("somewhere", "127.0.0.1:", "127.0.0.1:99999"):
        assert f"--http: got '{http}'. Give HOST:PORT" in refused("mcp", "--http", http)


async def test_a_mask_is_sent_and_most_grasps_fit_a_context(dummy_server, folder: Path) -> None:
    async with agent(dummy_server.http_url, folder) as client:
        asked = IMAGE | {"num_grasps": 20}
        result = await client.call_tool(DEPTH, asked)
        assert 1 <= len(answer(result)["grasps"]) <= 20
        assert len(result.content[0].text) < 300 * 20
        shown = await client.call_tool("visualize_grasps", asked | {"mask_file": "mask.png"})
        assert shown.content[1].type == "image"


MASKED_CLOUD = {"point_cloud_file": "cloud.npy", "mask_file": "mask.png"}


@pytest.mark.parametrize(
    ("tool", "arguments", "told"),
    [
        (CLOUD, {"point_cloud_file": "none.npy"}, "none.npy"),
        (CLOUD, {"point_cloud_file": "../outside.npy"}, "not below"),
        (CLOUD, {"point_cloud_file": "pipe.npy"}, "not a file"),
        (CLOUD, {"point_cloud_file": "loop.npy"}, "loop"),
        (CLOUD, {"object": "bottle"}, "object"),
        (CLOUD, {"num_grasps": -3}, "greater than or equal to 1"),
        (CLOUD, {"robot": {"name": "r2d2", "joints": [0.0]}}, "options.robot.name"),
        (CLOUD, {"robot": {"name": "fr3"}}, "options.robot.joints"),
        (CLOUD, {"options": {"tok_k": 1}}, "options.tok_k"),
        (CLOUD, {"options": {"timeout": 1}}, "options.timeout"),
        (CLOUD, {"options": {"top_k": 1}}, "options.top_k: got num_grasps as well"),
        (DEPTH, {"depth_file": "depth.png", "intrinsics": [1]}, "fx, fy"),
        (DEPTH, IMAGE | {"robot": {"name": "fr3"}}, "give T_base_camera"),
        ("visualize_grasps", IMAGE | {"T_base_camera": [[1.0], [0.0, 1.0]]}, "T_cloud_camera"),
        (DEPTH, IMAGE | {"options": {"robot": None, "tok_k": 1}}, "options.tok_k"),
        ("visualize_grasps", {}, "Give point_cloud_file alone, or depth_file"),
        ("visualize_grasps", MASKED_CLOUD, "Give point_cloud_file alone, or depth_file"),
    ],
)
async def test_what_is_wrong_reaches_the_agent(dummy_server, folder, tool, arguments, told) -> None:
    if tool == CLOUD:
        arguments = {"point_cloud_file": "cloud.npy"} | arguments
    async with agent(dummy_server.grpc_address, folder) as client:
        result = await client.call_tool(tool, arguments)
    assert result.is_error
    assert told in result.content[0].text
    assert str(folder.parent) not in result.content[0].text


def test_one_interrupt_ends_it(dummy_server, folder) -> None:
    words = ["mcp", "--server", dummy_server.grpc_address, "--folder", str(folder)]
    first = {"protocolVersion": "2025-06-18", "capabilities": {}}
    first |= {"clientInfo": {"name": "me", "version": "1"}}
    line = json.dumps({"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": first})
    with started(*EDGEGRASP, *words, stdin=subprocess.PIPE) as serving:
        serving.stdin.write(line + "\n")
        serving.stdin.flush()
        assert "serverInfo" in serving.stdout.readline()
        serving.send_signal(signal.SIGINT)
        serving.wait(30)


class Planning:
    """A client of a server with a robot, which reaches the second grasp, or none."""

    def __init__(self, client: GraspClient, reaches: bool) -> None:
        self._client, self._reaches = client, reaches

    def detect(self, *cloud: Any, robot: dict[str, Any], **asked: Any) -> Detection:
        self.robot = robot
        found = self._client.detect(*cloud, **asked)
        joints = np.array([0.123456, -1.0])
        times, rows = np.array([0.0, 1.0, 2.5]), np.zeros((3, 2))
        motion = ArmTrajectory(["a", "b"], times, rows, rows, 1, 2)
        arm = ArmPlan(True, joints, 2 * joints, motion)
        far = ArmPlan(False, None, None, None)
        plans = [arm if self._reaches else far, far]
        grasps = [replace(one, arm=plan) for one, plan in zip(found.grasps, plans, strict=True)]
        return replace(found, grasps=grasps, counts={"reachable": 0})


@pytest.mark.parametrize("reaches", [True, False])
async def test_an_agent_gets_the_joints_of_a_robot(dummy_server, folder, reaches) -> None:
    asked = IMAGE | {"T_base_camera": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}
    robot = {"name": "arm", "joints": [0.0, 0.0]}
    with GraspClient(dummy_server.grpc_address) as client:
        planning = Planning(client, reaches)
        async with mcp.Client(grasp_tools(planning, folder)) as agent:
            tools = {tool.name: tool for tool in (await agent.list_tools()).tools}
            jsonschema.validate(asked | {"robot": robot}, tools[DEPTH].input_schema)
            with pytest.raises(jsonschema.ValidationError):
                jsonschema.validate(asked | {"robot": {"name": "arm"}}, tools[DEPTH].input_schema)
            call = asked | {"robot": robot, "num_grasps": 2}
            found = answer(await agent.call_tool(DEPTH, call))
    assert planning.robot == robot | {"T_base_cloud": np.eye(4).ravel().tolist()}
    far = {"reachable": False}
    near = {"reachable": True, "seconds": 2.5}
    near |= {"pregrasp_joints": [0.1235, -1.0], "grasp_joints": [0.2469, -2.0]}
    assert [grasp["arm"] for grasp in found["grasps"]] == [near if reaches else far, far]
    assert ("counts" in found) != reaches  # which say why no grasp is within reach


async def test_the_tools_over_http(dummy_server, folder: Path) -> None:
    flags = ["--server", dummy_server.grpc_address, "--folder", folder]
    (port,) = free_ports(1)
    with started(sys.executable, *PROGRAM, *flags, "--http", f"127.0.0.1:{port}") as process:
        with socket.socket() as probe:
            until(lambda: process.poll() is not None or not probe.connect_ex(("127.0.0.1", port)))
        async with mcp.Client(f"http://127.0.0.1:{port}/mcp") as client:
            found = await client.call_tool(CLOUD, {"point_cloud_file": "cloud.npy"})
            assert len(answer(found)["grasps"]) == 5
