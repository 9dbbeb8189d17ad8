"""Bad requests: each gets an error that names field, value and fix, the same on both transports."""

import base64
import json
from typing import Any

import numpy as np
import pytest
from tests.checks import bounded_memory
from tests.cloud_files import depth_image, npy, point_cloud2

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.over_grpc import fill
from edgegrasp_service.errors import Problem

from .conftest import ask, form, part, problem

POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3)).astype(np.float32)
ROS = point_cloud2(POINTS)


class Malformed:
    """A request, as JSON has it, and what is said of it."""

    def __init__(
        self, field, value, fix, options=None, kind="invalid-request", scores=False, **sent
    ):
        self.field, self.value, self.fix, self.kind, self.scores = field, value, fix, kind, scores
        self._sent = {"options": options or {}} | sent

    def as_json(self) -> bytes:
        def plain(part: Any) -> Any:
            return base64.b64encode(part).decode() if isinstance(part, bytes) else part.tolist()

        return json.dumps(self._sent, default=plain).encode()

    def as_message(self) -> bytes:
        message = grasp_pb2.ScoreGraspsRequest() if self.scores else grasp_pb2.DetectGraspsRequest()
        points = {"points": self._sent["points"].tobytes()} if "points" in self._sent else {}
        fill(message, self._sent | points, "request")
        return message.SerializeToString()


def image(depths: float = 0.4, fx: float = 20.0, **changes: Any) -> dict[str, Any]:
    """A good depth image of 8 x 10 pixels, with changes."""
    return depth_image(np.full((8, 10), depths, "<f4"), fx, 20.0, 4.5, 3.5, **changes)


def option(name: str, value: Any, at: str, got: str, fix: str) -> Malformed:
    return Malformed(f"options.{name}{at}", got, fix, {name: value}, points=POINTS)


def shape(**fields: Any) -> dict[str, Any]:
    return {"include": [fields]}


POSE = np.eye(4).ravel().tolist()
HELD = {"id": 7, "T_cloud_hand": POSE}


def previous(**fields: Any) -> dict[str, Any]:
    return {"gripper": "panda", "grasps": [HELD], **fields}


CASES = {
    # The cloud.
    "no cloud": Malformed("cloud", "nothing", "Se"),
    "NaN": Malformed("cloud", "row 17", "finite", points=np.insert(POINTS, 17, np.nan, axis=0)),
    # PointCloud2.
    "PointCloud2 of integers": Malformed(
        "point_cloud2.fields", "z of type 5", "float32",
        point_cloud2=ROS | {"fields": [*ROS["fields"][:2], ROS["fields"][2] | {"datatype": 5}]},
    ),
    "PointCloud2 without z": Malformed(
        "point_cloud2.fields", "'x'", "Send at least 3 items.",
        point_cloud2=ROS | {"fields": ROS["fields"][:2]},
    ),
    "PointCloud2 of too many points": Malformed(
        "point_cloud2", "2500001 points", "2500000", kind="payload-too-large",
        point_cloud2=ROS | {"width": 2_500_001},
    ),
    # Depth images.
    "depth image cut short": Malformed(
        "depth_images.0.depth.data", "4 bytes", "whole image",
        depth_images=[image(depth=image()["depth"] | {"data": bytes(4)})],
    ),
    "depth image of negative depth": Malformed(
        "depth_images.0.depth", "-0.5 m", "0 or NaN",
        depth_images=[image(-0.5)],
    ),
    "depth images without a reading": Malformed(
        "depth_images", "no reading", "above 0", depth_images=[image(0.0)] * 2
    ),
    "no focal length": Malformed(
        "depth_images.0.intrinsics.fx", "0.0", "greater than 0", depth_images=[image(fx=0.0)]
    ),
    "camera pose that is no rotation": Malformed(
        "depth_images.0.T_cloud_camera", "2.0", "rotation",
        depth_images=[image(T_cloud_camera=np.diag([2.0, 1, 1, 1]).tolist())],
    ),
    "depth images beside a viewpoint": Malformed(
        "options.viewpoint", "0.0, 0.0, 1.0", "Leave it out",
        {"viewpoint": [0.0, 0.0, 1.0]}, depth_images=[image()],
    ),
    # Options.
    "unknown model": Malformed(
        "options.model", "'resnet'", "dummy", {"model": "resnet"}, "unknown-model", points=POINTS
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
    "no segment": option(
        "contact_region", shape(kind="segments", ids=[]), ".include.0.ids", "[]", "at least 1"
    ),
    "approach direction of nothing": option("approach_direction", {}, "", "{", "cone"),
    "object of no number": option("objects", {"include": [-1]}, ".include.0", "-1", "equal to 0"),
    # What an earlier answer found.
    "an id that leaves no room for others": option(
        "previous", previous(next_id=2**31 - 1), ".next_id", "2147483647", "less than"
    ),
    "grasps of two with one id": option(
        "previous", previous(grasps=[HELD, HELD]), "", "{", "7 is the id of two of them"
    ),
    "10,000 previous grasps": option(
        "previous", previous(grasps=[{**HELD, "id": n} for n in range(10_000)]), ".grasps", "",
        "at most 64",
    ),
    "previous pose that is not rigid": option(
        "previous", previous(grasps=[{**HELD, "T_cloud_hand": [2.0, *POSE[1:]]}]),
        ".grasps.0.T_cloud_hand", "2.0", "a rotation and a translation",
    ),
    "surface of two numbers": option(
        "previous", previous(objects=[{"number": 0, "surface": [0.1, 0.2]}]), ".objects.0.surface",
        "0.2", "three numbers for each point",
    ),
    # Numbers beyond every measure, and what is no number.
    "viewpoint beyond measure": option("viewpoint", [0.0, 1e300, 0.0], ".1", "1e+300", "10000000"),
    "plane beyond measure": option(
        "support", {"normal": [0.0, 0.0, 1.0], "offset": -1e8}, ".offset", "-100000000", "-10000000"
    ),
    "camera beyond measure": Malformed(
        "depth_images.0.T_cloud_camera.0.3", "1e+200", "10000000",
        depth_images=[image(T_cloud_camera=[[1, 0, 0, 1e200], *np.eye(4)[1:].tolist()])],
    ),
    "65 viewpoints": option("viewpoint", [[0.0, 0.0, 1.0]] * 65, "", "", "at most 64"),
    # Edges and hand poses.
    "edges and hand poses": Malformed(
        "hand_poses", "and edges", "one", points=POINTS, edges=[[0, 1]], hand_poses=[np.eye(4)],
        scores=True,
    ),
    "edge to no point": Malformed(
        "edges", "60", "59", points=POINTS, edges=[[0, 1], [2, 60]], scores=True
    ),
    "too many edges": Malformed(
        "edges", "16001", "16000", points=POINTS, edges=[[0, 1]] * 16001, scores=True
    ),
    "robot while scoring": Malformed(
        "options.robot", "with given grasps", "detect",
        {"robot": {"name": "fr3", "T_base_cloud": POSE, "joints": [0.0] * 7}},
        points=POINTS, edges=[[0, 1]], scores=True,
    ),
    "bad option while scoring": Malformed(
        "options.collision.margin", "-1.0", "greater", {"collision": {"margin": -1.0}},
        points=POINTS, edges=[[0, 1]], scores=True,
    ),
}  # fmt: skip


@pytest.mark.parametrize("transport", ["http", "grpc"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_malformed(case: Malformed, transport: str) -> None:
    body = case.as_json() if transport == "http" else case.as_message()
    error = problem(transport, body, "application/json", scores=case.scores)
    assert_refused_as(error, case.field, case.value, case.fix, case.kind)


def assert_refused_as(
    error: Problem, field: str, value: str, fix="", kind="invalid-request"
) -> None:
    assert (error.kind, error.field) == (kind, field)
    assert value in error.value
    assert fix in error.fix


JSON_CASES = {  # what gRPC cannot get wrong
    "no rows": ({"points": [0.0, 0.0, 0.0]}, "cloud", "shape (3,)", "(N, 3)"),
    "unknown field": ({"points": [], "pints": []}, "pints", "unknown", "points,"),
    "option beside the options": ({"points": [], "at": [1, 2]}, "at", "unknown", "`options`"),
    "word for a direction": (
        {"points": [], "options": {"approach_direction": "side"}}, "options.approach_direction",
        "'side'", "an object as ApproachDirection",
    ),
    "text for a viewpoint": (
        {"points": [], "options": {"viewpoint": "0 0 1"}}, "options.viewpoint", "'0 0 1'", "a list"
    ),
    "true for a seed": (
        {"points": [], "options": {"seed": True}}, "options.seed", "True", "number"
    ),
    "text for a number": (
        {"points": [], "options": {"min_score": "0.5"}}, "options.min_score", "'0.5'", "number"
    ),
    "unknown field of a shape": (
        {"points": [], "options": {"contact_region": {"include": [{"kind": "sphere", "r": 1}]}}},
        "options.contact_region.include.0.center", "nothing", "required",
    ),
    "no object": ([1, 2], "body", "[1, 2]", "object"),
    "NaN": (b'{"points": [[NaN, 0, 0], [0, 0, Infinity]]}', "cloud", "2 points with NaN", "finite"),
    "key twice": (b'{"points": [], "points": []}', "body", "2 times the key 'points'", "once"),
    "option twice": (
        b'{"points": [], "options": {"seed": 1, "seed": 2}}', "body", "the key 'seed'", "once"
    ),
    "empty": (b"", "body", "invalid JSON", "object"),
    "deep": (b"[" * 10_000, "body", "", ""),
    "long number": (b"1" * 5_000, "body", "5000 digits)", "object"),
    "half a character": (b'{"\\ud800": 1}', "\\ud800", "unknown", "only"),
    "more lists than points have": (
        b'{"points": [' + b"[]," * 200_000 + b"[]]}", "body", "200003 lists", "numbers"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("document", "field", "value", "fix"), JSON_CASES.values(), ids=JSON_CASES)
def test_bad_json(document: Any, field: str, value: str, fix: str) -> None:
    body = document if isinstance(document, bytes) else json.dumps(document).encode()
    assert_refused_as(problem("http", body, "application/json"), field, value, fix)


def test_the_shortest_points_and_edges_there_are() -> None:
    points = b"[0,0,0]," * 5_000 + b"[0,0,1]"
    edges = b",".join([b"[0,1]"] * 4_000)
    for beside, score in ((b"", False), (b',"edges":[' + edges + b"]", True)):
        body = b'{"points":[' + points + b"]" + beside + b"}"
        assert ask("http", body, "application/json", scores=score).error is None


@pytest.mark.parametrize("media_type", ["", "text/plain", "application/x-las"])
def test_unread_media_type(media_type: str) -> None:
    error = problem("http", b"0 0 0", media_type)
    assert (error.status, error.field, error.value) == (415, "Content-Type", repr(media_type))
    assert "application/x-ply" in error.fix


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("sead=1", "options.sead"),
        ("viewpoint=1,2", "options.viewpoint.2"),
        ("seed=1&seed=2", "options.seed"),
        ("workspace={%22min%22:[0,0,0],%22min%22:[0,0,0]}", "options.workspace"),
        ("&".join(f"x{row}=1" for row in range(100)), "query"),
    ],
)
def test_bad_queries(query: str, field: str) -> None:
    assert problem("http", npy(POINTS), "application/x-npy", query).field == field


CLOUD = part("cloud", npy(POINTS), '; filename="a.npy"')
FIRST = "depth_images.0"
FIXES = {"depth": ".png", f"{FIRST}.depth": "depth=@FILE", f"{FIRST}.intrinsics": "fx, fy, cx, cy"}


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (form(part("cloud", npy(POINTS), '; filename="a.las"')), "format"),
        (form(part("cluod", npy(POINTS), '; filename="a.npy"')), "cluod"),
        (form(part("cloud", npy(POINTS))), "cloud"),
        (form(part("options", b"{}", '; filename="o.json"')), "cloud"),
        (form(CLOUD, CLOUD), "cloud"),
        (form(CLOUD, part("options", b"{")), "options"),
        (form(CLOUD, part("options", b"[]")), "options"),
        (form(CLOUD, part("options", b'{"seed": -1}')), "options.seed"),
        (form(part("point_cloud2", npy(POINTS), '; filename="a.npy"')), "point_cloud2"),
        (form(part("depth", bytes(4000), '; filename="depth.tiff"')), "depth"),
        (form(part("depth", b"depth.png"), part("intrinsics", b"60,60,2,2")), f"{FIRST}.depth"),
        (form(part("depth", b"[[0.5]]"), part("intrinsics", b"60 60 2 2")), f"{FIRST}.intrinsics"),
        (form(CLOUD, end=b""), "body"),
        (form(("Content-Type: text/plain", b"{}")), "body"),
        (b"--b\r\nno header at all\r\n--b--\r\n", "body"),
        (b"garbage", "body"),
        (b"", "body"),
        # 30 MB of these once took two seconds each.
        (b"\r\n--b" * 1_000_000, "body"),
        (b"\r\n--" * 1_000_000, "body"),
        (form(*[CLOUD] * 1000), "body"),
    ],
)
def test_bad_forms(body: bytes, field: str) -> None:
    error = problem("http", body, "multipart/form-data; boundary=b")
    assert (error.status // 100, error.field, "413" in error.value) == (4, field, False)
    assert FIXES.get(field, "") in error.fix
    assert problem("http", body, "multipart/form-data").field == "body"


def test_a_good_form() -> None:
    parts = (CLOUD, part("options", b'{"top_k": 3}'), part("segment_ids", b"[%s0]" % (b"0," * 59)))
    quoted = 'multipart/form-data; charset=utf-8; boundary="b"'
    for body in (form(*parts), b"preamble\r\n" + form(*parts) + b"epilogue"):
        assert ask("http", body, quoted).facts.grasps == 3


@pytest.mark.parametrize(
    ("body", "field", "value"),
    [
        (grasp_pb2.DetectGraspsRequest(points=bytes(11)), "points", "11 bytes"),
        (grasp_pb2.DetectGraspsRequest(points=bytes(12), normals=b"a"), "normals", "1 bytes"),
        (grasp_pb2.DetectGraspsRequest(), "cloud", "nothing"),
        (b"\xff\xff\xff", "request", "3 bytes that are not a message"),
    ],
)
def test_bad_messages(body: Any, field: str, value: str) -> None:
    body = body if isinstance(body, bytes) else body.SerializeToString()
    assert_refused_as(problem("grpc", body), field, value)


@pytest.mark.parametrize(
    "field",
    ["request", "request.options", "request.options.viewpoint.0",
     "request.options.contact_region.exclude.0"],
)  # fmt: skip
def test_unknown_fields_in_a_message(field: str) -> None:
    message: Any = grasp_pb2.DetectGraspsRequest(points=POINTS.tobytes())
    part = message
    for name in field.split(".")[1:]:
        part = part.add() if name == "0" else getattr(part, name)
    part.MergeFromString(b"\xfa\x3f\x01a")  # number 1023, one byte
    assert_refused_as(problem("grpc", message.SerializeToString()), field, "1023")


MANY = 200_000


@pytest.mark.parametrize(
    ("field", "body"),
    [
        ("options.viewpoint", {"options": {"viewpoint": [{}] * MANY}}),
        ("options.collision.obstacles", {"options": {"collision": {"obstacles": [{}] * MANY}}}),
        (
            "options.contact_region.include",
            {"options": {"contact_region": {"include": [{"indices": {}}] * MANY}}},
        ),
        ("depth_images", {"depth_images": [{}] * MANY}),
        ("edges", {"edges": [{}] * MANY}),
        ("hand_poses", {"hand_poses": [{}] * MANY}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_many_empty_messages_are_counted_not_read(field, body) -> None:
    """Two bytes each on the wire, and once half a kilobyte each in Python."""
    content = grasp_pb2.ScoreGraspsRequest(points=POINTS.tobytes(), **body).SerializeToString()
    with bounded_memory(2_000_000):
        error = problem("grpc", content, scores=field in ("edges", "hand_poses"))
    assert (error.kind, error.field, error.value) == ("invalid-request", field, f"{MANY} of them")
