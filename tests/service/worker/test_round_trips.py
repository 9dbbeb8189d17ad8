"""Options survive every way they are written: JSON, query text and protobuf, both ways."""

import json
from typing import Any

import numpy as np
import pytest
from tests.many_options import MANY

from edgegrasp.v1 import grasp_pb2
from edgegrasp_client.over_grpc import fill
from edgegrasp_client.requests import plain_options
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.request_cloud import options_of_texts
from edgegrasp_service.worker.messages import plain_options as options_from_message

POSE = np.eye(4).ravel().tolist()
GRIPPER = {
    "name": "mine",
    "max_opening": 0.07,
    "tip_z": 0.1,
    "contact_z": 0.09,
    "tcp_z": -0.08,
    "hand": {"boxes": [[[-0.1, -0.1, -0.1], [0.1, 0.1, 0.05]]]},
    "finger": {"boxes": [[[-0.01, 0.0, 0.05], [0.01, 0.01, 0.1]], [[-1, 0.5, 0], [1, 1, 0.05]]]},
    "swing": {"radius": 0.5, "reach": 0.1},
}
ORIENTED = {"kind": "oriented_box", "center": [0.1, 0, 0], "half_extents": [1, 2, 3]}
MASK = {"kind": "mask", "mask": [True, False, True]}
ROBOT = {"name": "fr3", "T_base_cloud": POSE, "joints": [0.0, -1.5], "avoid_unseen": True}
EXAMPLES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "many": MANY,
    "text that looks like something else": {"model": "7", "gripper": "7"},
    "one viewpoint": {"viewpoint": (0.0, 0.0, 1.0)},
    "one viewpoint in a list": {"viewpoint": ((0.0, 0.0, 1.0),)},
    "objects": {
        "objects": {"include": [0, 2], "exclude": [1]},
        "at": [3.0, 4.5],
        "near": [0.1, 0.2, 0.3],
        "max_object_size": 0.3,
    },
    "every object": {"objects": "off", "suppression": None, "support": None, "gripper": GRIPPER},
    "shapes": {
        "approach_region": {"include": [ORIENTED | {"quaternion": [0, 0, 0, 1]}, MASK]},
        "support": {"normal": [0, 0, 1], "offset": 0.1, "max_depth_error": 0.1},
    },
    "previous": {
        "previous": {
            "gripper": "panda",
            "next_id": 8,
            "grasps": [{"id": 7, "T_cloud_hand": POSE, "object": 3}],
            "objects": [{"number": 3, "surface": [0.0] * 6, "confidence": 0.5}],
            "search": True,
        }
    },
    "a robot that places by a pose": {"robot": ROBOT | {"place": {"T_base_object": POSE}}},
    "a robot that places in a region": {
        "robot": ROBOT
        | {"plan": "reach", "place": {"region": {"min": [0, 0, 0], "max": [1, 1, 1]}}}
    },
    "zeros and empty lists, which protobuf calls defaults": {
        "support": {"normal": [0, 0, 1], "offset": 0.0},
        "approach_region": {"include": [{"kind": "indices", "indices": []}]},
        "contact_region": {"include": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]},
        "suppression": {"translation": 0.0, "rotation": 0.0},
        "collision": {"approach_length": 0.0},
        "min_score": 0.0,
        "seed": 0,
        "debug": False,
    },
}


def through_message(fields: dict[str, Any]) -> DetectOptions:
    """As the client sends it and the server reads it."""
    message = grasp_pb2.DetectOptions()
    fill(message, plain_options(fields), "options")
    arrived = grasp_pb2.DetectOptions.FromString(message.SerializeToString())
    return parse_options(options_from_message(arrived))


def through_query(fields: dict[str, Any]) -> DetectOptions:
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in plain_options(fields).items()
    }
    return parse_options(options_of_texts(texts.items()))


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_request_means_the_same_however_it_is_sent(name: str) -> None:
    expected = parse_options(EXAMPLES[name])
    for sent in (EXAMPLES[name], expected.model_dump(mode="json")):
        assert through_message(sent) == expected
        assert parse_options(json.loads(json.dumps(sent))) == expected
        assert through_query(sent) == expected


def test_every_option_has_an_example() -> None:
    assert {field for fields in EXAMPLES.values() for field in fields} == set(
        DetectOptions.model_fields
    )
