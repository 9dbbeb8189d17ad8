"""Messages between the front and its workers: plain values as JSON, and bodies as bytes."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO, Literal

from edgegrasp_service.errors import Problem

HEADER = struct.Struct(">QQ")  # bytes of a message's JSON, and of the body that follows it
PIECE = 2**16  # bytes of a body that the front reads or writes at a time

Method = Literal["DetectGrasps", "ScoreGrasps", "RecordOutcome", "Beat"]  # Beat: nothing
Transport = Literal["http", "grpc"]


@dataclass(frozen=True)
class Job:
    """One request as it arrived; the front passes it on undecoded."""

    method: Method
    transport: Transport
    body: bytes  # of HTTP, or the serialized request message
    remaining: float = 0.0  # seconds until its deadline at the time it was handed over
    content_type: str = ""  # HTTP: the header as sent
    query: str = ""  # HTTP: the query string, without the question mark
    request_id: str = ""  # for the worker's log
    pieces: Sequence[bytearray] = ()  # the body where the front has it in pieces

    @property
    def parts(self) -> Sequence[bytes | bytearray]:
        """The body, in one or more parts."""
        return self.pieces or (self.body,)

    @property
    def size(self) -> int:
        """Bytes of the body."""
        return sum(map(len, self.parts))


@dataclass
class Facts:
    """Facts about a request for logs and metrics, as far as it got."""

    model: str = ""  # name of the weights
    points: int = 0  # in the cloud as sent, holes included
    grasps: int = 0  # returned, or evaluated if given by the caller
    seconds: dict[str, float] = field(default_factory=dict)  # of each stage, in order
    counts: dict[str, int] = field(default_factory=dict)  # what passed each stage
    options: str = ""  # options that differ from the defaults, as shortened JSON
    traceback: str = ""  # of an internal error


@dataclass(frozen=True)
class Answer:
    """The result of a job."""

    body: bytes  # JSON, or the serialized response message; empty for an error
    facts: Facts
    error: Problem | None = None  # None: a success


@dataclass(frozen=True)
class Ready:
    """The first message of the nursery and of each worker."""

    pid: int
    models: list[dict[str, Any]]  # the catalogue's description of its weights; from workers
    failure: str = ""  # why loading failed
    robots: list[dict[str, Any]] = field(default_factory=list)  # the description of each robot


MESSAGES = {kind.__name__: kind for kind in (Ready, Job, Answer)}


def pack(message: object) -> Sequence[bytes | bytearray]:
    """Serialize one of MESSAGES: lengths, plain fields as JSON, and the body without a copy."""
    text = json.dumps([type(message).__name__, message], default=_plain).encode()
    parts = message.parts if isinstance(message, Job) else (getattr(message, "body", b""),)
    return HEADER.pack(len(text), sum(map(len, parts))) + text, *parts


def unpack(text: bytes, body: bytes) -> Any:
    """Deserialize a message from its plain fields, as JSON, and its body."""
    name, fields = json.loads(text)
    if "body" in fields:
        fields["body"] = body
    if name == "Answer":
        fields["facts"] = Facts(**fields["facts"])
        fields["error"] = fields["error"] and Problem(**fields["error"])
    return MESSAGES[name](**fields)


def receive(file: BinaryIO) -> Any:
    """The next message; None: there are no more."""
    head = file.read(HEADER.size)
    if len(head) < HEADER.size:
        return None
    length, body_length = HEADER.unpack(head)
    return unpack(file.read(length), file.read(body_length))


def _plain(value: Any) -> Any:
    """What JSON has in place of a value that it lacks: a message's fields; "" for a body."""
    if isinstance(value, bytes):
        return ""
    return {name: field for name, field in vars(value).items() if name != "pieces"}
