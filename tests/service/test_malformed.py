"""Malformed requests, each sent over both transports: the same code, field, value and fix."""

import base64
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.grpc_wire import fill

INVALID = {"grpc": "INVALID_ARGUMENT", "rest": "400"}
NOT_FOUND = {"grpc": "NOT_FOUND", "rest": "404"}
TOO_LARGE = {"grpc": "RESOURCE_EXHAUSTED", "rest": "413"}
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3)).astype(np.float32)
NAN = float("nan")


@dataclass
class Malformed:
    """A request, and what is said of it."""

    field: str
    value: str
    fix: str
    options: dict[str, Any] = field(default_factory=dict)
    codes: dict[str, str] = field(default_factory=lambda: INVALID)
    points: Any = None
    beside: dict[str, np.ndarray] = field(default_factory=dict)
    images: list[dict[str, Any]] | None = None
    ros: dict[str, Any] | None = None
    edges: list[list[int]] | None = None
    poses: Any = None
    scores: bool = False

    def as_json(self) -> dict[str, Any]:
        body: dict[str, Any] = {"options": self.options}
        if self.points is not None:
            body["points"] = np.asarray(self.points).tolist()
        body |= {name: array.tolist() for name, array in self.beside.items()}
        named = {"depth_images": self.images, "point_cloud2": self.ros, "edges": self.edges}
        body |= {name: value for name, value in named.items() if value is not None}
        if self.poses is not None:
            body["hand_poses"] = np.asarray(self.poses).tolist()
        text = json.dumps(body, default=lambda data: base64.b64encode(data).decode())
        decoded: dict[str, Any] = json.loads(text)
        return decoded

    def as_message(self) -> Any:
        message = grasp_pb2.ScoreGraspsRequest() if self.scores else grasp_pb2.DetectGraspsRequest()
        fill(message.options, self.options, "options")
        if self.points is not None:
            message.points = np.asarray(self.points, np.float32).tobytes()
        for name, array in self.beside.items():
            kind = "<f4" if name in ("normals", "colors") else "<i4"
            setattr(message, name, array.astype(kind).tobytes())
        for image in self.images or ():
            flat = np.ravel(image["T_cloud_camera"]).tolist()
            fill(message.depth_images.add(), image | {"T_cloud_camera": flat}, "depth_images")
        if self.ros is not None:
            fill(message.point_cloud2, self.ros, "point_cloud2")
        for edge in self.edges or ():
            message.edges.add(approach_index=edge[0], contact_index=edge[1])
        for pose in [] if self.poses is None else self.poses:
            message.hand_poses.add(T_cloud_hand=np.ravel(pose).tolist())
        return message


def image(**changes: Any) -> dict[str, Any]:
    """A good depth image of 8 x 10 pixels, with changes."""
    depth = np.linspace(0.4, 0.5, 80, dtype="<f4")
    fields = {"height": 8, "width": 10, "encoding": "32FC1", "data": depth.tobytes()}
    inner = {name: changes.pop(name) for name in list(changes) if name in fields}
    camera = {"fx": 20.0, "fy": 20.0, "cx": 4.5, "cy": 3.5}
    pinhole = {name: changes.pop(name) for name in list(changes) if name in camera}
    pose = {"T_cloud_camera": np.eye(4).tolist()} | changes
    return {"depth": fields | inner, "intrinsics": camera | pinhole} | pose


def ros(**changes: Any) -> dict[str, Any]:
    """A good PointCloud2 of 60 points, with changes."""
    fields = [
        {"name": name, "offset": 4 * row, "datatype": 7, "count": 1}
        for row, name in enumerate("xyz")
    ]
    layout = {"height": 1, "width": 60, "fields": fields, "is_bigendian": False}
    return layout | {"point_step": 12, "row_step": 720, "data": POINTS.tobytes()} | changes


def option(name: str, value: Any, at: str, got: str, fix: str) -> Malformed:
    return Malformed(f"options.{name}{at}", got, fix, {name: value}, points=POINTS)


def shape(**fields: Any) -> dict[str, Any]:
    return {"include": [fields]}


def spoiled(row: int, value: float) -> np.ndarray:
    cloud = POINTS.copy()
    cloud[row, 0] = value
    return cloud


GRIPPER = {
    "max_opening": 0.08,
    "tip_z": 0.1,
    "contact_z": 0.09,
    "tcp_z": 0.1,
    "hand": {"boxes": [[[-0.1, -0.1, -0.1], [0.1, 0.1, 0.05]]]},
    "finger": {"boxes": [[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]]]},
}

CASES = {
    # The cloud.
    "no cloud": Malformed("", "nothing", "Se"),
    "empty cloud": Malformed("cloud", "no points", "num_approach_points", points=POINTS[:0]),
    "NaN": Malformed("cloud", "row 17", "finite", points=spoiled(17, NAN)),
    "infinity": Malformed("cloud", "row 3", "finite", points=spoiled(3, np.inf)),
    "millimetres": Malformed("cloud", "millimetres", "divide by 1000", points=POINTS * 1000),
    "fewer points than approach points": Malformed(
        "cloud", "5 points for num_approach_points = 32", "lower options.num", points=POINTS[:5]
    ),
    "normals for other points": Malformed(
        "normals", "shape (59, 3)", "60 points", points=POINTS, beside={"normals": POINTS[1:]}
    ),
    "normals with NaN": Malformed(
        "normals", "row 2", "finite", points=POINTS, beside={"normals": spoiled(2, NAN)}
    ),
    "colours for other points": Malformed(
        "colors", "shape (10, 3)", "60 points", points=POINTS, beside={"colors": POINTS[:10]}
    ),
    "segment ids for other points": Malformed(
        "segment_ids", "shape (61,)", "60", points=POINTS, beside={"segment_ids": np.arange(61)}
    ),
    "view ids for other points": Malformed(
        "view_ids", "shape (3,)", "60", {"viewpoint": [[0, 0, 1], [1, 0, 1]]},
        points=POINTS, beside={"view_ids": np.arange(3)},
    ),
    # PointCloud2.
    "PointCloud2 without z": Malformed(
        "point_cloud2.fields", "x, y, w", "Send z",
        ros=ros(fields=[*ros()["fields"][:2], {**ros()["fields"][2], "name": "w"}]),
    ),
    "PointCloud2 of integers": Malformed(
        "point_cloud2.fields.2.datatype", "5", "float32",
        ros=ros(fields=[*ros()["fields"][:2], {**ros()["fields"][2], "datatype": 5}]),
    ),
    "PointCloud2 of an unknown type": Malformed(
        "point_cloud2.fields.0.datatype", "9", "8",
        ros=ros(fields=[{**ros()["fields"][0], "datatype": 9}, *ros()["fields"][1:]]),
    ),
    "PointCloud2 with a field beyond the point": Malformed(
        "point_cloud2.fields.2.offset", "'z'", "point_step = 11", ros=ros(point_step=11)
    ),
    "PointCloud2 with short rows": Malformed(
        "point_cloud2.row_step", "700", "width * point_step", ros=ros(row_step=700)
    ),
    "PointCloud2 truncated": Malformed(
        "point_cloud2.data", "700 bytes", "whole cloud", ros=ros(data=POINTS.tobytes()[:700])
    ),
    "PointCloud2 of negative height": Malformed(
        "point_cloud2.height", "-1", "greater", ros=ros(height=-1)
    ),
    "PointCloud2 with x twice": Malformed(
        "point_cloud2.fields.1.name", "'x'", "once",
        ros=ros(fields=[ros()["fields"][0]] * 2 + ros()["fields"][2:]),
    ),
    "PointCloud2 of too many points": Malformed(
        "point_cloud2", "2000001 points", "2000000", codes=TOO_LARGE, ros=ros(width=2_000_001)
    ),
    # Depth images.
    "depth image cut short": Malformed(
        "depth_images.0.depth.data", "4 bytes", "whole image", images=[image(data=bytes(4))]
    ),
    "depth image of colours": Malformed(
        "depth_images.1.depth.encoding", "'rgb8'", "16UC1",
        images=[image(), image(encoding="rgb8")],
    ),
    "depth image without pixels": Malformed(
        "depth_images.0.depth.height", "0", "greater", images=[image(height=0)]
    ),
    "depth image of negative depth": Malformed(
        "depth_images.0.depth", "-0.5 m", "0 or NaN",
        images=[image(data=np.full(80, -0.5, "<f4").tobytes())],
    ),
    "depth image without a reading": Malformed(
        "cloud", "holes only", "finite", images=[image(data=bytes(320))]
    ),
    "no focal length": Malformed(
        "depth_images.0.intrinsics.fx", "0.0", "greater than 0", images=[image(fx=0.0)]
    ),
    "camera pose that is no rotation": Malformed(
        "depth_images.0.T_cloud_camera", "2.0", "rotation",
        images=[image(T_cloud_camera=np.diag([2.0, 1, 1, 1]).tolist())],
    ),
    "depth images beside a viewpoint": Malformed(
        "options.viewpoint", "0.0, 0.0, 1.0", "Leave it out",
        {"viewpoint": [0.0, 0.0, 1.0]}, images=[image()],
    ),
    "depth images beside points": Malformed(
        "depth_images", "beside points", "one", points=POINTS, images=[image()]
    ),
    # Options.
    "unknown model": Malformed(
        "options.model", "'resnet'", "dummy", {"model": "resnet"}, NOT_FOUND, points=POINTS
    ),
    "no approach points": option("num_approach_points", 0, "", "0", "greater"),
    "too many candidates": option("num_candidates", 10**6, "", "1000000", "16000"),
    "unknown sampling": option("sampling", "best", "", "'best'", "'uniform'"),
    "negative seed": option("seed", -1, "", "-1", "greater"),
    "NaN in a viewpoint": option("viewpoint", [NAN, 0.0, 0.0], ".0", "nan", "finite"),
    "no direction up": option("up", [0.0, 0.0, 0.0], "", "[0.0, 0.0, 0.0]", "zero vector"),
    "support normal of length 2": option(
        "support", {"normal": [0.0, 0.0, 2.0], "offset": 0.0}, ".normal", "2.0", "length 1"
    ),
    "support plane without offset": option(
        "support", {"normal": [0.0, 0.0, 1.0]}, ".offset", "nothing", "required"
    ),
    "depths wrong by half": option(
        "support", {"normal": [0.0, 0.0, 1.0], "offset": 0.0, "max_depth_error": 0.5},
        ".max_depth_error", "0.5", "0.3",
    ),
    "RANSAC without a distance": option(
        "support", {"kind": "ransac", "distance": 0.0}, ".distance", "0.0", "greater than 0"
    ),
    "workspace upside down": option(
        "workspace", {"min": [1.0, 0.0, 0.0], "max": [0.0, 1.0, 1.0]}, "", "min", "below"
    ),
    "ball without a radius": option(
        "approach_region", shape(kind="sphere", center=[0.0, 0.0, 0.0], radius=0.0),
        ".include.0.radius", "0.0", "greater than 0",
    ),
    "quaternion of length 2": option(
        "contact_region",
        shape(kind="oriented_box", center=[0] * 3, half_extents=[1] * 3, quaternion=[0, 0, 0, 2]),
        ".include.0.quaternion", "2", "length 1",
    ),
    "negative index": option(
        "approach_region", shape(kind="indices", indices=[4, -1]), ".include.0.indices.1", "-1",
        "greater",
    ),
    "no segment": option(
        "contact_region", shape(kind="segments", ids=[]), ".include.0.ids", "[]", "at least 1"
    ),
    "approach direction of nothing": option("approach_direction", {}, "", "{", "cone"),
    "cone too wide": option(
        "approach_direction", {"cones": [{"direction": [0.0, 0.0, -1.0], "max_angle": 4.0}]},
        ".cones.0.max_angle", "4.0", "less",
    ),
    "unknown preset": option("approach_direction", {"preset": "up"}, ".preset", "'up'", "'side'"),
    "unknown collision mode": option("collision", {"mode": "dodge"}, ".mode", "'dodge'", "'avoid'"),
    "margin of a metre": option("collision", {"margin": 1.0}, ".margin", "1.0", "0.1"),
    "obstacle upside down": option(
        "collision", {"obstacles": [{"kind": "box", "min": [1.0] * 3, "max": [0.0] * 3}]},
        ".obstacles.0", "min", "below",
    ),
    "gripper without fingertips": option(
        "gripper", {name: GRIPPER[name] for name in GRIPPER if name != "tip_z"}, ".tip_z",
        "nothing", "required",
    ),
    "gripper that contradicts itself": option(
        "gripper", GRIPPER | {"tip_z": 0.2}, "", "max_opening", "highest z"
    ),
    "score above 1": option("min_score", 1.5, "", "1.5", "less"),
    "no grasp asked for": option("top_k", 0, "", "0", "greater"),
    "negative suppression": option("suppression", {"rotation": -1.0}, ".rotation", "-1.0", "great"),
    "unknown order": option("order", "best", "", "'best'", "'clearance'"),
    # Edges and hand poses.
    "nothing to score": Malformed("edges", "nothing", "hand_poses", points=POINTS, scores=True),
    "edges and hand poses": Malformed(
        "hand_poses", "beside edges", "one", points=POINTS, edges=[[0, 1]], poses=[np.eye(4)],
        scores=True,
    ),
    "edge to no point": Malformed(
        "edges", "60", "59", points=POINTS, edges=[[0, 1], [2, 60]], scores=True
    ),
    "edge from a negative row": Malformed(
        "edges", "-1", "59", points=POINTS, edges=[[-1, 1]], scores=True
    ),
    "too many edges": Malformed(
        "edges", "16001", "16000", points=POINTS, edges=[[0, 1]] * 16001, scores=True
    ),
    "NaN in a hand pose": Malformed(
        "hand_poses", "row 1", "finite", points=POINTS, poses=[np.eye(4), np.full((4, 4), NAN)],
        scores=True,
    ),
    "bad option while scoring": Malformed(
        "options.collision.margin", "-1.0", "greater", {"collision": {"margin": -1.0}},
        points=POINTS, edges=[[0, 1]], scores=True,
    ),
}  # fmt: skip


def send(case: Malformed, raw: Any) -> Any:
    if raw.name == "grpc":
        return raw.send(case.as_message())
    content = json.dumps(case.as_json())  # with NaN, which httpx would not write
    path = "/v1/grasps:score" if case.scores else "/v1/grasps"
    return raw.post(path, content=content, headers={"content-type": "application/json"})


def test_there_are_fifty() -> None:
    assert len(CASES) >= 50


@pytest.mark.parametrize("name", CASES)
def test_malformed(name: str, raw: Any) -> None:
    case = CASES[name]
    answer = send(case, raw)
    assert answer.code == case.codes[raw.name]
    assert answer.field == case.field or not case.field
    assert case.value in answer.value
    assert case.fix in answer.fix
    for part in (answer.field, answer.value, answer.fix):
        assert part
        assert part in answer.detail
    good = Malformed("", "", "", points=POINTS)
    assert send(good, raw).code in ("OK", "200")
