"""Grasps written in protobuf's wire format."""

import numpy as np
import pytest

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.results import Grasp
from edgegrasp_service.grasp_wire import grasp_messages


def _grasps(count: int, seed: int) -> list[Grasp]:
    rng = np.random.default_rng(seed)

    def array(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return [
        Grasp(
            score=float(rng.random()),
            T_cloud_hand=array(4, 4),
            T_cloud_tcp=array(4, 4),
            width=float(rng.random()),
            approach_point=array(3),
            contact_point=array(3),
            approach_direction=array(3),
            collision_free=bool(rng.integers(2)),
            clearance=float(rng.normal()),
        )
        for _ in range(count)
    ]


def _by_field(grasp: Grasp) -> grasp_pb2.Grasp:
    fields = {name: getattr(grasp, name) for name in grasp_pb2.Grasp.DESCRIPTOR.fields_by_name}
    return grasp_pb2.Grasp(
        **{
            name: value.ravel().tolist() if isinstance(value, np.ndarray) else value
            for name, value in fields.items()
        }
    )


@pytest.mark.parametrize("count", [0, 1, 7])
def test_messages_are_those_made_field_by_field(count: int) -> None:
    grasps = _grasps(count, seed=count)
    assert grasp_messages(grasps) == [_by_field(grasp) for grasp in grasps]


def test_a_grasp_of_zeros_is_an_empty_message() -> None:
    nothing = np.zeros(3, np.float32)
    pose = np.zeros((4, 4), np.float32)
    zeros = Grasp(0.0, pose, pose, 0.0, nothing, nothing, nothing, False, 0.0)
    (message,) = grasp_messages([zeros])
    assert message == _by_field(zeros)
    assert not message.collision_free
