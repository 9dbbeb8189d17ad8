"""The gRPC transport: requests, answers and errors as messages."""

from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import grpc.aio
import numpy as np
from google.protobuf.message import DecodeError, Message

from edgegrasp.v1 import grasp_pb2
from edgegrasp_camera.arrays import Array
from edgegrasp_client import errors
from edgegrasp_client.connection import Tls, token_metadata
from edgegrasp_client.errors import GraspClientError, error_of_kind, invalid
from edgegrasp_client.requests import Request, cloud_file, float32_points
from edgegrasp_client.results import Answer, Model, StreamAnswer, field_of, read_as
from edgegrasp_results import Detection

CHANNEL_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.lb_policy_name", "round_robin"),  # balance over all servers of a name
    ("grpc.initial_reconnect_backoff_ms", 100),  # servers restart within seconds
    ("grpc.max_reconnect_backoff_ms", 1000),
    # Detects servers that vanished, and ends streams to them.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
)

SERVICE = "edgegrasp.v1.GraspService"

# grpc.health.v1: an empty request asks about the whole server; field 1 = 1 means SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

ERROR_METADATA = "edgegrasp-error-bin"

_BY_CODE: dict[grpc.StatusCode, type[GraspClientError]] = {
    grpc.StatusCode.DEADLINE_EXCEEDED: errors.DeadlineError,
    grpc.StatusCode.INVALID_ARGUMENT: errors.InvalidRequestError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: errors.PayloadTooLargeError,
    grpc.StatusCode.UNAUTHENTICATED: errors.AccessDeniedError,
    grpc.StatusCode.PERMISSION_DENIED: errors.AccessDeniedError,
    grpc.StatusCode.CANCELLED: errors.ServerUnavailableError,
    grpc.StatusCode.INTERNAL: errors.ServerUnavailableError,  # of a proxy; ours send more detail
    grpc.StatusCode.UNKNOWN: errors.ServerFailedError,
}


class GrpcTransport:
    """Calls over one channel; raises GraspClientErrors."""

    def __init__(self, address: str, token: str | None, tls: Tls | None) -> None:
        self._address = address
        if tls is None:
            self._channel = grpc.aio.insecure_channel(address, CHANNEL_OPTIONS)
        else:
            try:
                ca, certificate, key = (file and Path(file).read_bytes() for file in astuple(tls))
            except OSError as error:
                raise invalid("tls", f"{tls} ({error})", "Give PEM files.") from None
            credentials = grpc.ssl_channel_credentials(ca, key, certificate)
            self._channel = grpc.aio.secure_channel(address, credentials, CHANNEL_OPTIONS)
        self._metadata = token_metadata(token)
        self._check = self._channel.unary_unary(HEALTH_CHECK, bytes, bytes)

    async def ask(self, kind: type[Answer], request: Request, timeout: float) -> Answer:
        """The answer to a request."""
        name = "ScoreGrasps" if request.scores else "DetectGrasps"
        answer = await self._call(name, b"".join(wire_of(request)), timeout)
        return read_as(kind, answer)

    async def listed(self, kind: type[Answer], timeout: float) -> list[Answer]:
        """The server's models or robots."""
        name = f"{kind.__name__}s"
        answer = await self._call(f"List{name}", b"", timeout)
        return [read_as(kind, each) for each in getattr(answer, name.lower())]

    async def record_outcome(self, tried: dict[str, Any], timeout: float) -> None:
        """Refused: gRPC has no such call."""
        raise invalid("address", "gRPC", "Outcomes are taken over REST: give http://host:port.")

    async def detect_stream(
        self, requests: AsyncIterator[tuple[str, Request, float]]
    ) -> AsyncGenerator[StreamAnswer, None]:
        """An answer to each of the named requests with their timeouts."""
        failed: list[Exception] = []

        async def messages() -> AsyncIterator[bytes]:
            try:
                async for name, request, seconds in requests:
                    message = grasp_pb2.DetectGraspsStreamRequest(request_id=name, timeout=seconds)
                    wire = _field(message, "request", *wire_of(request))
                    yield b"".join([message.SerializeToString(), *wire])
            except Exception as error:  # gRPC would only log it
                failed.append(error)

        read = grasp_pb2.DetectGraspsStreamResponse.FromString
        method = self._channel.stream_stream(f"/{SERVICE}/DetectGraspsStream", None, read)
        call: Any = method(messages(), metadata=self._metadata)
        try:
            async for answer in call:
                if answer.HasField("detection"):
                    detection = read_as(Detection, answer.detection)
                    yield StreamAnswer(answer.request_id, detection)
                else:
                    error = _described(answer.error.message, answer.error.detail)
                    yield StreamAnswer(answer.request_id, error=error)
        except grpc.RpcError as error:
            raise _error_of(error, self._address) from None
        finally:
            call.cancel()
        if failed:
            raise failed[0]

    async def ready(self, timeout: float) -> bool:
        """Whether the server answers requests."""
        try:
            return bool(await self._check(b"", timeout=timeout) == SERVING)
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.UNIMPLEMENTED:
                return False
        try:  # a server without gRPC's health service, such as Ray's: try a request
            return bool(await self.listed(Model, timeout))
        except GraspClientError:
            return False

    async def close(self) -> None:
        """Close the channel."""
        await self._channel.close(None)

    async def _call(self, name: str, request: bytes, timeout: float) -> Any:
        """The answer of a method of the service to a serialized request."""
        response = getattr(grasp_pb2, f"{name}Response")
        method = self._channel.unary_unary(f"/{SERVICE}/{name}", None, response.FromString)
        try:
            return await method(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _error_of(error, self._address) from None


# Errors


def _error_of(error: Any, address: str) -> GraspClientError:
    """The exception for a failed call, as the server describes it or by its status code."""
    code, message = error.code(), error.details() or ""
    metadata = dict(error.trailing_metadata() or ())
    try:
        detail = grasp_pb2.ErrorDetail.FromString(metadata[ERROR_METADATA])
    except (DecodeError, KeyError):
        if code == grpc.StatusCode.UNAVAILABLE:
            return errors.unreachable(address, message)
        return _BY_CODE.get(code, errors.ProtocolError)(f"{code.name}: {message}")
    return _described(message, detail)


def _described(message: str, detail: grasp_pb2.ErrorDetail) -> GraspClientError:
    retry_after = field_of(detail, "retry_after")
    return error_of_kind(detail.kind, message, detail.field, detail.value, detail.fix, retry_after)


# Requests


def wire_of(request: Request) -> list[bytes | memoryview]:
    """The serialized message of a request, in parts; InvalidRequestError: no message can hold it.

    Protobuf would copy long fields four times. A message whose fields come in two parts is merged.
    """
    kind = grasp_pb2.ScoreGraspsRequest if request.scores else grasp_pb2.DetectGraspsRequest
    message: Any = kind()
    long: list[bytes | memoryview] = []
    cloud = request.cloud
    if cloud is None:
        for which, image in enumerate(request.depth_images):
            view, depth = grasp_pb2.DepthImage(), dict(image["depth"])
            data = _field(view.depth, "data", depth.pop("data"))
            fill(view, image | {"depth": depth}, f"depth_images.{which}")
            whole = view.SerializeToString(), *_field(view, "depth", *data)
            long += _field(message, "depth_images", *whole)
    elif (points := float32_points(cloud)) is not None:
        long += _field(message, "points", _little_endian(points))
    else:
        message.encoded.format, message.encoded.data = cloud_file(cloud)
    for name, array in request.arrays.items():
        if name in ("edges", "hand_poses"):
            _extend(getattr(message, name), array, name, messages=True)
        else:
            long += _field(message, name, _little_endian(array))
    fill(message.options, request.options, "options")
    return [message.SerializeToString(), *long]


def _little_endian(array: Array) -> memoryview:
    """The bytes of a contiguous array, without a copy where they are that already."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1).view(np.uint8).data


def _field(message: Message, name: str, *parts: bytes | memoryview) -> list[bytes | memoryview]:
    """A field of a message as it is on the wire: its bytes or serialized message, in parts."""
    head = bytearray()
    number = message.DESCRIPTOR.fields_by_name[name].number
    for value in (number << 3 | 2, sum(map(len, parts))):
        while value > 127:
            head.append(value & 127 | 128)
            value >>= 7
        head.append(value)
    return [bytes(head), *parts]


def fill(message: Message, value: object, path: str) -> None:
    """Fill a message from a plain value in the form it has in JSON.

    Raises:
        InvalidRequestError: The message cannot hold the value. The server checks everything else.
    """
    message, value = _target(message, value, path)
    if not isinstance(value, Mapping):
        raise invalid(path, repr(value)[:80], f"Give a mapping with {_known(message)}.")
    message.SetInParent()
    for name, part in value.items():
        field = message.DESCRIPTOR.fields_by_name.get(name)
        here = f"{path}.{name}"
        if field is None:
            raise invalid(here, "an unknown field", f"Give {_known(message)} only.")
        if field.is_repeated:
            _extend(getattr(message, name), part, here, field.message_type is not None)
        elif field.message_type is not None:
            fill(getattr(message, name), part, here)
        else:
            try:
                setattr(message, name, part)
            except (TypeError, ValueError) as error:
                raise invalid(here, repr(part)[:80], f"{error}.") from None


def _extend(container: Any, values: object, path: str, messages: bool) -> None:
    if isinstance(values, np.ndarray):
        values = values.tolist()
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise invalid(path, repr(values)[:80], "Give a list.")
    if messages:
        for row, value in enumerate(values):
            fill(container.add(), value, f"{path}.{row}")
        return
    by_rows = path.rpartition(".")[2].startswith(("T_", "surface"))  # as answers in JSON have them
    if by_rows and all(isinstance(row, list) for row in values):
        values = [number for row in values for number in row]
    try:
        container.extend(values)
    except (TypeError, ValueError) as error:
        fix = f"Give one flat list, or an array of bool. {error}."
        raise invalid(path, repr(values)[:80], fix) from None


def _known(message: Message) -> str:
    internal = ("disabled", "ransac", "auto", "object_choice")  # JSON writes these differently
    return ", ".join(f.name for f in message.DESCRIPTOR.fields if f.name not in internal)


def _target(message: Any, value: Any, path: str) -> tuple[Any, Any]:
    """What to fill, and with which fields; JSON writes some messages in another way."""
    names = [field.name for field in message.DESCRIPTOR.fields]
    fields = dict(value) if isinstance(value, Mapping) else {}
    match message.DESCRIPTOR.name:
        case "DetectOptions":  # one viewpoint may be given without a list
            if isinstance(fields.get("objects"), Mapping):
                fields["object_choice"] = fields.pop("objects")
            viewpoint = fields.get("viewpoint")
            listed = isinstance(viewpoint, list) and viewpoint and isinstance(viewpoint[0], list)
            if viewpoint is not None and not listed:
                fields["viewpoint"] = [viewpoint]
            return message, fields
        case "HandPose":
            return message, {names[0]: value}
        case "Edge" | "HandBox" | "Pixel" | "Vector" | "Quaternion" as kind:
            if not isinstance(value, Sequence) or len(value) != len(names):
                parts = "corners" if kind == "HandBox" else "numbers"
                raise invalid(path, repr(value)[:80], f"Give {parts}: {', '.join(names)}.")
            return message, dict(zip(names, value, strict=True))
        case "GripperChoice":
            named = isinstance(value, str)
            return (message, {"name": value}) if named else (message.geometry, value)
        case "Shape" | "Obstacle":
            kind = fields.pop("kind", None)
            if kind not in names:
                found = kind if isinstance(value, Mapping) else value
                fix = f"Set its kind to one of {', '.join(names)}."
                raise invalid(path, repr(found)[:80], fix)
            return getattr(message, kind), fields
        case "Support":
            if value is None or value == "none":
                return message, {"disabled": True}
            kind = value if isinstance(value, str) else fields.pop("kind", "plane")
            if kind in ("auto", "ransac"):
                return getattr(message, kind), fields
            if kind != "plane" or {"auto", "ransac"} & fields.keys():
                fix = "Set its kind to one of auto, plane, ransac, none."
                raise invalid(path, repr(kind)[:80], fix)
            return message, fields if isinstance(value, Mapping) else value
        case "Suppression" if value is None:
            return message, {"disabled": True}
        case "Collision" if isinstance(value, str):
            return message, {"mode": value}
    return message, value
