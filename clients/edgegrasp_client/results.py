"""The server's answers and errors as typed values, and their parser for both transports."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from functools import cache, partial
from types import NoneType
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from edgegrasp_camera.arrays import Float64
from edgegrasp_client import errors
from edgegrasp_results import ArmTrajectory, Detection


@dataclass(frozen=True)
class Model:
    """Weights that a server has loaded."""

    name: str
    architecture: str
    digest: str
    parameters: int
    crop_radius: float  # metres
    voxel_size: float  # metres
    gripper: str
    default: bool  # whether a request that names no model uses these weights
    hand_description: bool  # whether the network also sees the hand-frame description
    device: str = ""  # "cpu", or a GPU such as "cuda:0"


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm with a gripper. J joints; radians and seconds, metres for sliding joints."""

    name: str
    gripper: str  # name of the gripper that its grasps are for
    base_frame: str  # link that `T_base_cloud` refers to
    joint_names: list[str]  # J
    home: Float64  # (J,) position without self-collision
    lower: Float64  # (J,) limits
    upper: Float64
    max_velocity: Float64
    max_acceleration: Float64
    # (J + 1, 4, 4) pose of each joint's frame, at joint value 0, in the previous joint's frame; the
    # first is in the base frame; the last is the hand's pose in the last joint's frame
    frames: Annotated[Float64, (-1, 4, 4)]
    axes: Annotated[Float64, (-1, 3)]  # (J, 3) axis of rotation or sliding, in the joint's frame
    sliding: list[bool]  # J


@dataclass(frozen=True, eq=False)
class StreamAnswer:
    """The answer to one request of a stream: a detection or an error."""

    request_id: str
    detection: Detection | None = None
    error: errors.GraspClientError | None = None

    def result(self) -> Detection:
        """The detection; raises the error if there is none."""
        if self.detection is None:
            assert self.error is not None
            raise self.error
        return self.detection


# The server's stages in order, since gRPC maps have no order.
_STAGES = (
    *("cloud", "points", "in_workspace", "above_support", "voxels", "kept", "in_approach_region"),
    *("approach_points", "pairs", "in_contact_region", "candidates", "in_direction"),
    *("clear_of_support", "checked", "collision_free", "given", "scored", "above_min_score"),
    *("suppressed", "on_arm", "hand_collision", "out_of_reach", "arm_collision", "no_place"),
    *("reachable", "with_trajectory", "returned", "description", "network", "ranking", "arm"),
)

Answer = TypeVar("Answer")


def field_of(answer: Any, name: str) -> Any:
    """A field of a JSON object or of a message; None if a message lacks it."""
    if isinstance(answer, Mapping):
        return answer[name]
    absent = answer.DESCRIPTOR.fields_by_name[name].has_presence and not answer.HasField(name)
    return None if absent else getattr(answer, name)


def read_as(kind: type[Answer], answer: Any) -> Answer:
    """An answer, or an object in one, as one of the dataclasses above."""
    fields = _fields(cast("Any", kind))
    values = {name: value(field_of(answer, name)) for name, value in fields}
    if kind is ArmTrajectory:  # gRPC has the rows flattened
        for name in ("positions", "velocities"):
            values[name] = values[name].reshape(-1, len(values["joint_names"]))
    return cast("Callable[..., Answer]", kind)(**values)


@cache
def _fields(kind: type[Any]) -> list[tuple[str, Callable[[Any], Any]]]:
    """Each field of a dataclass, with the function that reads its value."""
    hints = get_type_hints(kind, include_extras=True)
    return [(name, _value(hint)) for name, hint in hints.items()]


def _value(hint: Any) -> Callable[[Any], Any]:
    """The function that reads a field of this type; arrays get the shape of the annotation."""
    parts = [part for part in get_args(hint) if part is not NoneType]
    if NoneType in get_args(hint):
        given = _value(parts[0])
        scalar = parts[0] in (bool, float, int, str) or is_dataclass(parts[0])
        # gRPC sends an absent list as an empty one.
        return lambda value: None if value is None or not (scalar or len(value)) else given(value)
    if is_dataclass(hint):
        return partial(read_as, cast("type[Any]", hint))
    if get_origin(hint) is list:
        one = _value(parts[0])
        return lambda value: [one(part) for part in value]
    if get_origin(hint) is dict:  # in the order of the stages; unknown stages come last
        return lambda value: {
            name: value[name] for name in (*_STAGES, *sorted(value)) if name in value
        }
    if get_origin(hint) is Annotated:
        array, shape = _value(parts[0]), hint.__metadata__[0]
        return lambda value: array(value).reshape(shape)
    if get_origin(hint) is np.ndarray:
        (dtype,) = get_args(get_args(hint)[1])
        return lambda value: np.array(value, dtype=dtype)  # null in JSON becomes NaN
    return lambda value: value


# Kinds of errors that a server reports; some end with gRPC codes, which a proxy may send.
_KINDS: dict[type[errors.GraspClientError], tuple[str, ...]] = {
    errors.InvalidRequestError: (
        *("invalid-request", "unsupported-media-type", "headers-too-large", "harmful-request"),
        "invalid-argument",
    ),
    errors.StartCollisionError: ("start-collision",),
    errors.UnknownModelError: ("unknown-model",),
    errors.PayloadTooLargeError: ("payload-too-large", "resource-exhausted"),
    errors.AccessDeniedError: ("unauthenticated", "permission-denied"),
    errors.ServerUnavailableError: ("not-ready", "cancelled", "internal"),
    errors.OverloadedError: ("overloaded",),
    errors.WorkerLostError: ("worker-lost",),
    errors.DeadlineError: ("request-timeout", "deadline-exceeded"),
    errors.ServerFailedError: ("detector-failed", "disk-full", "unknown"),
}


def error_of_kind(
    kind: str, message: str, *where: str, retry_after: float | None = None
) -> errors.GraspClientError:
    """The exception for an error reported by the server; `where`: field, value and fix."""
    error = next((one for one, kinds in _KINDS.items() if kind in kinds), errors.ProtocolError)
    if issubclass(error, errors.OverloadedError) and retry_after is not None:
        return error(message, retry_after)
    if issubclass(error, errors.InvalidRequestError):
        return error(message, *where)
    return error(message)
