"""Options survive every way they are written: JSON, query text and protobuf, both ways."""

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.over_grpc import fill
from edgegrasp_client.requests import plain_options
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_service.worker.http_bodies import options_from_query
from edgegrasp_service.worker.messages import plain_options as options_from_message


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high)


coordinate = numbers(-10.0, 10.0)
vector = st.tuples(coordinate, coordinate, coordinate)
direction = vector.filter(lambda v: math.hypot(*v) > 1e-3)
unit = direction.map(lambda v: tuple((np.array(v) / np.linalg.norm(v)).tolist()))
quaternion = st.tuples(*[coordinate] * 4).filter(lambda v: math.hypot(*v) > 1e-3)
quaternion = quaternion.map(lambda v: tuple((np.array(v) / np.linalg.norm(v)).tolist()))
length = numbers(1e-6, 1.0)
row = st.integers(0, 2**31 - 1)


@st.composite
def corners(draw: st.DrawFn, reach: float = 10.0) -> dict[str, Any]:
    low = draw(st.tuples(*[numbers(-reach, reach - 0.5)] * 3))
    size = draw(st.tuples(*[numbers(0.01, 0.5)] * 3))
    return {"min": low, "max": tuple(np.add(low, size).tolist())}


def shape(kind: str, **fields: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"kind": st.just(kind)} | fields)


box = corners().map(lambda fields: {"kind": "box"} | fields)
oriented_box = st.fixed_dictionaries(
    {
        "kind": st.just("oriented_box"),
        "center": vector,
        "half_extents": st.tuples(length, length, length),
    },
    optional={"quaternion": quaternion},
)
shapes = st.lists(
    st.one_of(
        box,
        oriented_box,
        shape("sphere", center=vector, radius=length),
        shape("half_space", normal=unit, offset=coordinate),
        shape("indices", indices=st.lists(row, max_size=5)),
        shape("mask", mask=st.lists(st.booleans(), max_size=5)),
        shape("segments", ids=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=5)),
    ),
    max_size=4,
)
region = st.fixed_dictionaries({}, optional={"include": shapes, "exclude": shapes})
cones = st.lists(
    st.fixed_dictionaries({"direction": direction, "max_angle": numbers(0.0, math.pi)}), max_size=3
)
preset = st.sampled_from(["top-down", "side", None])
approach_direction = st.fixed_dictionaries({}, optional={"cones": cones, "preset": preset}).filter(
    lambda fields: fields.get("cones") or fields.get("preset")
)
gripper = st.fixed_dictionaries(
    {
        "max_opening": numbers(0.02, 0.2),
        "tip_z": st.just(0.1),
        "contact_z": numbers(0.06, 0.09),
        "tcp_z": numbers(-1.0, 1.0),
        "hand": st.just({"boxes": [[[-0.1, -0.2, -0.1], [0.1, 0.2, 0.05]]]}),
        "finger": st.just(
            {"boxes": [[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]], [[-1, 0.5, 0], [1, 1, 0.05]]]}
        ),
    },
    optional={
        "name": st.text(max_size=20),
        "swing": st.none() | st.just({"radius": 0.5, "reach": 0.1}),
    },
)
collision = st.fixed_dictionaries(
    {},
    optional={
        "mode": st.sampled_from(["avoid", "penalise", "ignore"]),
        "margin": numbers(0.0, 0.1),
        "opening": st.none() | length,
        "approach_length": numbers(0.0, 1.0),
        "retreat_length": numbers(0.0, 1.0),
        "retreat_direction": st.sampled_from(["back", "up"]),
        "obstacles": st.lists(box | oriented_box, max_size=3),
    },
)
plane = st.fixed_dictionaries(
    {"normal": unit, "offset": coordinate},
    optional={"kind": st.just("plane"), "max_depth_error": numbers(0.0, 0.3)},
)
ransac = st.fixed_dictionaries(
    {"kind": st.just("ransac")},
    optional={
        "distance": numbers(1e-4, 0.1),
        "max_tilt": numbers(0.0, 1.5),
        "min_share": numbers(1e-3, 1.0),
    },
)
auto = st.just({"kind": "auto"})
names = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)


def drawn(schema: dict[str, Any]) -> st.SearchStrategy[Any]:
    """What a number, a word or a truth may be."""
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    match schema.get("type"):
        case "boolean":
            return st.booleans()
        case "integer":
            return st.integers(schema["minimum"], schema.get("maximum", 2**63 - 1))
        case "number":
            return numbers(schema.get("minimum", 1e-6), schema["maximum"])
    return names


SCHEMAS = DetectOptions.model_json_schema()["properties"]
OPTIONS = {name: drawn(schema) for name, schema in SCHEMAS.items() if "anyOf" not in schema} | {
    "gripper": st.none() | st.sampled_from(["panda", "robotiq-2f-85", "7"]) | gripper,
    "viewpoint": st.none() | vector | st.lists(vector, min_size=1, max_size=4),
    "num_approach_points": st.none() | st.integers(1, 256),
    "up": st.none() | direction,
    "support": st.none() | st.sampled_from(["auto", "ransac", "none"]) | plane | ransac | auto,
    "workspace": st.none() | corners(),
    "approach_region": st.none() | region,
    "contact_region": st.none() | region,
    "approach_direction": st.none() | approach_direction,
    "collision": st.sampled_from(["avoid", "penalise", "ignore"]) | collision,
    "suppression": st.none()
    | st.fixed_dictionaries(
        {}, optional={"translation": numbers(0.0, 1.0), "rotation": numbers(0.0, 3.2)}
    ),
}
RIGID = np.eye(4).ravel().tolist()
OPTIONS["robot"] = st.none() | st.fixed_dictionaries(
    {
        "name": names,
        "T_base_cloud": st.just(RIGID) | vector.map(lambda v: [*RIGID[:3], v[0], *RIGID[4:]]),
        "joints": st.lists(coordinate, min_size=1, max_size=7),
    },
    optional={"plan": st.sampled_from(["reach", "motion"])},
)
any_options = st.fixed_dictionaries({}, optional=OPTIONS)


def through_message(fields: dict[str, Any]) -> DetectOptions:
    """As the client sends it and the server reads it."""
    message = grasp_pb2.DetectOptions()
    fill(message, plain_options(fields), "options")
    arrived = grasp_pb2.DetectOptions.FromString(message.SerializeToString())
    return parse_options(options_from_message(arrived))


def through_json(fields: object) -> DetectOptions:
    return parse_options(json.loads(json.dumps(fields)))


def through_query(fields: dict[str, Any]) -> DetectOptions:
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in plain_options(fields).items()
    }
    return parse_options(options_from_query(texts.items()))


@settings(max_examples=100, derandomize=True, deadline=None)
@given(fields=any_options)
def test_a_request_means_the_same_however_it_is_sent(fields: dict[str, Any]) -> None:
    expected = parse_options(fields)
    for sent in (fields, expected.model_dump(mode="json")):
        assert through_message(sent) == expected
        assert through_json(sent) == expected
        assert through_query(sent) == expected


@pytest.mark.parametrize("value", [(0.0, 0.0, 1.0), ((0.0, 0.0, 1.0),)])
def test_one_viewpoint_is_one(value: Any) -> None:
    assert through_message({"viewpoint": value}).viewpoint == (0.0, 0.0, 1.0)


def test_zeros_and_empty_lists_are_sent() -> None:
    """What protobuf calls a default is not what an option calls one."""
    fields: dict[str, Any] = {
        "support": {"normal": [0, 0, 1], "offset": 0.0},
        "approach_region": {"include": [{"kind": "indices", "indices": []}]},
        "contact_region": {"include": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]},
        "suppression": {"translation": 0.0, "rotation": 0.0},
        "collision": {"approach_length": 0.0},
        "min_score": 0.0,
        "seed": 0,
        "debug": False,
    }
    assert through_message(fields) == parse_options(fields)
