"""What crosses the pipe between the front and a worker: bytes and small plain values."""

from dataclasses import dataclass, field
from typing import Literal

from edgegrasp_service.errors import Problem

Method = Literal["DetectGrasps", "ScoreGrasps"]
Transport = Literal["http", "grpc"]


@dataclass(frozen=True)
class Job:
    """One request as it arrived; the front hands it on without looking into it."""

    method: Method
    transport: Transport
    body: bytes  # of HTTP, or the serialized request message
    remaining: float  # seconds until its deadline at the time it was handed over
    content_type: str = ""  # HTTP: the header as sent
    query: str = ""  # HTTP: the query string, without the question mark
    request_id: str = ""  # for the worker's log


@dataclass
class Facts:
    """What logs and metrics tell of a request, as far as it came."""

    model: str = ""  # name of the weights
    points: int = 0  # in the cloud as sent, holes included
    voxels: int = 0  # of the processed cloud
    grasps: int = 0  # returned, or evaluated where the caller gave them
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage, in order
    counts: dict[str, int] = field(default_factory=dict)  # what passed each stage
    options: str = ""  # those that are not the defaults, as JSON, cut short
    traceback: str = ""  # of a fault of the server's own


@dataclass(frozen=True)
class Answer:
    """What becomes of a job."""

    body: bytes  # JSON, or the serialized response message; empty for an error
    facts: Facts
    error: Problem | None = None  # None: a success


@dataclass(frozen=True)
class Limits:
    """The settings that bound one request."""

    max_points: int = 2_000_000  # in a cloud, before downsampling
    max_approach_points: int = 256
    max_candidates: int = 16_000
