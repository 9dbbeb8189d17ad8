"""Errors of the service, and the table that maps every error to its gRPC code and HTTP status."""

import re
from dataclasses import dataclass

import orjson

from edgegrasp_camera import PayloadTooLarge as PayloadTooLarge
from edgegrasp_camera import UnsupportedMediaType as UnsupportedMediaType
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, StartCollision, UnknownModel

STOPPING_MESSAGE = "The server is stopping. Try another one."  # the message of a NotReady


class Unauthenticated(InvalidRequest):
    """The token is missing or unknown; its value never appears in a message."""


class PermissionDenied(InvalidRequest):
    """The token does not permit the request."""


class HeadersTooLarge(InvalidRequest):
    """HTTP headers or gRPC metadata exceed the server's limits."""


class ReloadFailed(EdgeGraspError):  # noqa: N818
    """New weights cannot be used; the old ones stay in use."""


class NotReady(EdgeGraspError):  # noqa: N818
    """Weights are still loading, or the server is stopping."""


class Overloaded(EdgeGraspError):  # noqa: N818
    """The server is full."""

    def __init__(self, message: str, retry_after: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after = retry_after  # seconds


class RequestTimeout(InvalidRequest):
    """A body arrives too slowly."""


class DeadlineExceeded(EdgeGraspError):  # noqa: N818
    """The caller's deadline passed before the answer was ready."""

    def __init__(self, message: str = "The deadline passed before there was an answer.") -> None:
        super().__init__(message)


class Cancelled(EdgeGraspError):  # noqa: N818
    """The caller disconnected; this error is never read."""


class WorkerLost(EdgeGraspError):  # noqa: N818
    """The worker process of the request died or ran out of memory, and is being replaced."""


class HarmfulRequest(InvalidRequest):
    """A request that killed its worker process is refused for a while."""

    def __init__(self) -> None:
        fix = "Send another cloud or other options; this request is refused for 10 minutes."
        super().__init__("request", "one that crashed a worker", fix)


class DiskFull(EdgeGraspError):  # noqa: N818
    """The data to store cannot be written."""


class DetectorFailed(EdgeGraspError):  # noqa: N818
    """The detector failed on a good request."""


class InvalidSettings(EdgeGraspError):  # noqa: N818
    """A setting is of the wrong type, out of range or unknown."""


class AddressInUse(EdgeGraspError):  # noqa: N818
    """A port or socket cannot be bound."""

    def __init__(self, transport: str, place: str, why: str) -> None:
        port = f"another port: --{transport.lower()}-port"
        other = port if ":" in place else "another folder that exists: --host"
        fix = f"Stop what listens there, or choose {other}"
        super().__init__(f"{transport}: cannot listen on {place} ({why}). {fix}.")


# Names of gRPC codes, and HTTP statuses.
STATUS: dict[type[Exception], tuple[str, int]] = {
    InvalidRequest: ("INVALID_ARGUMENT", 400),
    StartCollision: ("INVALID_ARGUMENT", 400),
    UnknownModel: ("NOT_FOUND", 404),
    PayloadTooLarge: ("RESOURCE_EXHAUSTED", 413),
    UnsupportedMediaType: ("INVALID_ARGUMENT", 415),
    Unauthenticated: ("UNAUTHENTICATED", 401),
    PermissionDenied: ("PERMISSION_DENIED", 403),
    HeadersTooLarge: ("RESOURCE_EXHAUSTED", 431),
    ReloadFailed: ("FAILED_PRECONDITION", 409),
    NotReady: ("UNAVAILABLE", 503),
    Overloaded: ("RESOURCE_EXHAUSTED", 429),
    HarmfulRequest: ("INVALID_ARGUMENT", 422),
    RequestTimeout: ("DEADLINE_EXCEEDED", 408),
    DeadlineExceeded: ("DEADLINE_EXCEEDED", 504),
    Cancelled: ("CANCELLED", 499),  # 499: as nginx logs it
    WorkerLost: ("UNAVAILABLE", 503),
    DetectorFailed: ("INTERNAL", 500),
    DiskFull: ("RESOURCE_EXHAUSTED", 507),
}


@dataclass(frozen=True)
class Problem:
    """An error as both transports send it; plain values, as it crosses process boundaries."""

    kind: str  # the class's name in kebab case, e.g. "invalid-request"
    detail: str
    field: str
    value: str
    fix: str
    code: str  # name of the gRPC code, e.g. "INVALID_ARGUMENT"
    status: int  # of HTTP
    retry_after: float | None = None  # seconds


def to_problem(error: Exception) -> Problem:
    """Describe an error for the caller; an unknown error reveals nothing about itself."""
    if type(error) not in STATUS:
        error = DetectorFailed("The server failed; its log says why.")
    code, status = STATUS[type(error)]
    field, value, fix = "", "", ""
    if isinstance(error, InvalidRequest):
        field, value, fix = _sendable(error.field), _sendable(error.value), error.fix
    detail = f"{field}: got {value}. {fix}" if field else str(error)
    retry_after = error.retry_after if isinstance(error, Overloaded) else None
    return Problem(kind_of(type(error)), detail, field, value, fix, code, status, retry_after)


def unreadable_message(data: bytes) -> InvalidRequest:
    """The error for bytes that protobuf cannot read."""
    value = f"{len(data)} bytes that are not a message of this method"
    return InvalidRequest("request", value, "Send a message as the .proto file defines it.")


def problem_document(problem: Problem) -> bytes:
    """An error as a problem document (RFC 9457)."""
    title = problem.kind.replace("-", " ").capitalize()
    document = {"type": f"urn:edgegrasp:error:{problem.kind}", "title": title} | vars(problem)
    del document["kind"], document["code"]
    return orjson.dumps(document)


def _sendable(text: str) -> str:
    """A caller's text, shortened for gRPC metadata and without lone surrogates."""
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= 200 else text[:197] + "..."


def kind_of(error: type[Exception]) -> str:
    """The name of an error on the wire: InvalidRequest is "invalid-request"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", error.__name__).lower()
