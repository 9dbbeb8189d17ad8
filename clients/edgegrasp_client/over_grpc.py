"""The gRPC transport: requests, answers and errors as messages."""

import asyncio
from base64 import b64decode
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from dataclasses import astuple
from itertools import chain
from pathlib import Path
from typing import Any

import grpc.aio
import numpy as np
from google.protobuf.message import DecodeError, Message

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client.connection import (
    Tls,
    invalid,
    is_local,
    ssl_context,
    token_metadata,
    unreachable,
)
from edgegrasp_client.errors import GraspClientError
from edgegrasp_client.requests import Request, cloud_file
from edgegrasp_client.results import Answer, Model, StreamAnswer, error_of_kind, field_of, read_as
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

# grpc.health.v1: an empty request asks about the whole server; field 1 = 1 means SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

ACCEPT_SECONDS = 0.5  # seconds to wait for a server to accept a stream before sending requests
ERROR_METADATA = "edgegrasp-error-bin"


class GrpcTransport:
    """Calls over one channel; raises GraspClientErrors."""

    def __init__(self, address: str, token: str | None, tls: Tls | None) -> None:
        self._address = address
        options = (*CHANNEL_OPTIONS, ("grpc.enable_http_proxy", not is_local(address)))
        if tls is None:
            self._channel = grpc.aio.insecure_channel(address, options)
        else:
            ssl_context(tls)  # refuses files with which gRPC would fail to connect
            ca, certificate, key = (file and Path(file).read_bytes() for file in astuple(tls))
            credentials = grpc.ssl_channel_credentials(ca, key, certificate)
            self._channel = grpc.aio.secure_channel(address, credentials, options)
        self._metadata = token_metadata(token)
        self._service: Any = grasp_pb2_grpc.GraspServiceStub(self._channel)
        self._check = self._channel.unary_unary(HEALTH_CHECK, bytes, bytes)

    async def request(self, kind: type[Answer], request: Request, timeout: float) -> Answer:
        """The answer to a request."""
        name = "ScoreGrasps" if request.scores else "DetectGrasps"
        return read_as(kind, await self._call(name, message_of(request), timeout))

    async def list_all(self, kind: type[Answer], timeout: float) -> list[Answer]:
        """The server's models or robots."""
        name = f"List{kind.__name__}s"
        answer = await self._call(name, getattr(grasp_pb2, f"{name}Request")(), timeout)
        return [read_as(kind, each) for each in getattr(answer, f"{kind.__name__.lower()}s")]

    async def record_outcome(self, tried: dict[str, Any], timeout: float) -> None:
        """Refused: gRPC has no such call."""
        raise invalid("address", "gRPC", "Outcomes are taken over REST: give http://host:port.")

    async def detect_stream(
        self, requests: AsyncIterator[tuple[str, Request, float]]
    ) -> AsyncGenerator[StreamAnswer, None]:
        """An answer to each of the named requests with their timeouts."""
        failed: list[Exception] = []
        refused: deque[GraspClientError | None] = deque()  # by the client; they are sent empty
        sent = grasp_pb2.DetectGraspsStreamRequest

        async def messages() -> AsyncIterator[grasp_pb2.DetectGraspsStreamRequest]:
            try:
                # Writing to a refused stream would hide the reason; Ray accepts streams late.
                accepted = asyncio.ensure_future(call.initial_metadata())
                await asyncio.wait([accepted], timeout=ACCEPT_SECONDS)
                async for name, request, seconds in requests:
                    message = None
                    try:
                        message = message_of(request)
                        refused.append(None)
                    except GraspClientError as error:
                        refused.append(error)
                    yield sent(request_id=name, request=message, timeout=seconds)
            except Exception as error:  # gRPC would log it and not raise it
                failed.append(error)

        call = self._service.DetectGraspsStream(messages(), metadata=self._metadata)
        try:
            async for answer in call:
                wrong = refused.popleft()
                if answer.HasField("detection"):
                    yield StreamAnswer(answer.request_id, read_as(Detection, answer.detection))
                else:
                    error = wrong or _described(answer.error.message, answer.error.detail)
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
            return bool(await self.list_all(Model, timeout))
        except GraspClientError:
            return False

    async def close(self) -> None:
        """Close the channel."""
        await self._channel.close(None)

    async def _call(self, name: str, request: Message, timeout: float) -> Any:
        """The answer of a method of the service."""
        method = getattr(self._service, name)
        try:
            return await method(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise _error_of(error, self._address) from None


# Errors


def _error_of(error: Any, address: str) -> GraspClientError:
    """The exception for a failed call, from the server's ErrorDetail or from its status code."""
    code, message = error.code(), error.details() or ""
    metadata = dict(error.trailing_metadata() or ())
    try:
        detail = grasp_pb2.ErrorDetail.FromString(metadata[ERROR_METADATA])
    except (DecodeError, KeyError):
        if code == grpc.StatusCode.UNAVAILABLE:
            return unreachable(address, message)
        if "status: 413" in message:  # of a proxy
            return error_of_kind("payload-too-large", f"A proxy before {address}: {message}")
        return error_of_kind(code.name.lower().replace("_", "-"), f"{code.name}: {message}")
    return _described(message, detail)


def _described(message: str, detail: grasp_pb2.ErrorDetail) -> GraspClientError:
    where, after = (detail.field, detail.value, detail.fix), field_of(detail, "retry_after")
    return error_of_kind(detail.kind, message, *where, retry_after=after)


# Requests


def message_of(request: Request) -> Any:
    """The message of a request; raises InvalidRequestError for a value that does not fit in it."""
    fields: dict[str, Any] = {"options": request.options, "depth_images": request.depth_images}
    for name, array in request.arrays.items():
        little_endian = array.astype(array.dtype.newbyteorder("<"), copy=False)
        fields[name] = array if name in ("edges", "hand_poses") else little_endian.tobytes()
    if request.cloud is not None:
        fields["encoded"] = dict(zip(("format", "data"), cloud_file(request.cloud), strict=True))
    kind = grasp_pb2.ScoreGraspsRequest if request.scores else grasp_pb2.DetectGraspsRequest
    message = kind()
    fill(message, fields)
    return message


def fill(message: Message, value: object, path: str = "") -> None:
    """Fill a message, the field `path` of a request, from a value in JSON form.

    Raises InvalidRequestError if the value does not fit. The server checks everything else.
    """
    message, value = _target(message, value, path)
    if not isinstance(value, Mapping):
        raise invalid(path, repr(value)[:80], f"Give a mapping with {_known(message)}.")
    message.SetInParent()
    for name, part in value.items():
        field = message.DESCRIPTOR.fields_by_name.get(name)
        here = f"{path}.{name}".removeprefix(".").replace("object_choice", "objects")
        if field is None:
            raise invalid(here, "an unknown field", f"Give {_known(message)} only.")
        if isinstance(part, np.ndarray):
            part = part.tolist()
        if field.message_type is None:
            try:
                if not field.is_repeated:
                    setattr(message, name, part)
                elif name.startswith(("T_", "surface")) and all(isinstance(r, list) for r in part):
                    getattr(message, name).extend(chain(*part))  # in JSON also row by row
                elif name == "mask" and isinstance(part, str):  # in JSON also in base64
                    getattr(message, name).extend(map(bool, b64decode(part, validate=True)))
                else:
                    getattr(message, name).extend(part)
            except (TypeError, ValueError) as error:
                raise invalid(here, repr(part)[:80], f"{error}.") from None
        elif not field.is_repeated:
            fill(getattr(message, name), part, here)
        elif isinstance(part, Sequence) and not isinstance(part, str):
            for row, each in enumerate(part):
                fill(getattr(message, name).add(), each, f"{here}.{row}")
        else:
            raise invalid(here, repr(part)[:80], "Give a list.")


def _known(message: Message) -> str:
    internal = ("disabled", "ransac", "auto", "object_choice")  # JSON writes these differently
    return ", ".join(f.name for f in message.DESCRIPTOR.fields if f.name not in internal)


def _target(message: Any, value: Any, path: str) -> tuple[Any, Any]:
    """The message to fill and its fields; some messages have another form in JSON."""
    names = [field.name for field in message.DESCRIPTOR.fields]
    fields = dict(value) if isinstance(value, Mapping) else {}
    if "disabled" in fields:  # null in JSON
        raise invalid(f"{path}.disabled", "an unknown field", f"Give {_known(message)} only.")
    match message.DESCRIPTOR.name:
        case "DetectOptions":  # one viewpoint may be given without a list
            if isinstance(fields.get("objects"), Mapping):
                fields["object_choice"] = fields.pop("objects")
            viewpoint = fields.get("viewpoint")
            listed = isinstance(viewpoint, list) and viewpoint and isinstance(viewpoint[0], list)
            if viewpoint is not None and not listed:
                fields["viewpoint"] = [viewpoint]
            return message, fields
        case "Edge" | "HandBox" | "Pixel" | "Vector" | "Quaternion":
            if not isinstance(value, Sequence) or len(value) != len(names):
                raise invalid(path, repr(value)[:80], f"Give a list: {', '.join(names)}.")
            return message, dict(zip(names, value, strict=True))
        case "Shape" | "Obstacle":
            kind = fields.pop("kind", None)
            if kind not in names:
                fix = f"Set its kind to one of {', '.join(names)}."
                raise invalid(path, repr(value if kind is None else kind)[:80], fix)
            return getattr(message, kind), fields
        case "Support" | "Suppression" if value is None:
            return message, {"disabled": True}
        case "Support" if value == "none":
            return message, {"disabled": True}
        case "Support":
            kind = value if isinstance(value, str) else fields.pop("kind", "plane")
            if kind in ("auto", "ransac"):
                return getattr(message, kind), fields
            if kind != "plane" or {"auto", "ransac"} & fields.keys():
                fix = "Set its kind to one of auto, plane, ransac, none."
                raise invalid(path, repr(kind)[:80], fix)
            return message, fields if isinstance(value, Mapping) else value
        case "HandPose":
            return message, {names[0]: value}
        case "Collision" | "GripperChoice" if isinstance(value, str):
            return message, {names[0]: value}
        case "GripperChoice":
            return message.geometry, value
    return message, value
