"""What goes between the pool and its processes: messages of plain JSON, and bodies as bytes."""

import contextlib
import json
import socket
import struct
from dataclasses import dataclass
from typing import Any

from edgegrasp_service.errors import Problem
from edgegrasp_service.worker.job import Answer, Facts, Job

HEADER = struct.Struct(">QQ")  # bytes of a message's JSON, and of the body that follows it
LOST = "The worker of this request died or ran out of memory. Try again, or send fewer points."


@dataclass(frozen=True)
class Start:
    """What the nursery is told first."""

    settings: dict[str, Any]  # those that are not secret


@dataclass(frozen=True)
class Ready:
    """What the nursery and its workers say first."""

    pid: int
    models: list[dict[str, Any]]  # as `answer.describe` gives them; of workers


@dataclass(frozen=True)
class Failed:
    """Why there will be no worker."""

    reason: str


MESSAGES = {kind.__name__: kind for kind in (Start, Ready, Failed, Job, Answer)}


def send(to: socket.socket, message: object) -> None:
    """Send one message."""
    head, body = pack(message)
    to.sendall(head)
    to.sendall(body)


def receive(source: socket.socket) -> Any:
    """The next message; None: the other side has closed."""
    if not (head := _read(source, HEADER.size)):
        return None
    length, body_length = HEADER.unpack(head)
    return unpack(_read(source, length), bytes(_read(source, body_length)))


def pack(message: object) -> tuple[bytes, bytes]:
    """One of MESSAGES as bytes: the lengths and its plain fields, and its body, not copied."""
    text = json.dumps([type(message).__name__, message], default=_plain).encode()
    body: bytes = getattr(message, "body", b"")
    return HEADER.pack(len(text), len(body)) + text, body


def unpack(text: bytes | bytearray, body: bytes) -> Any:
    """The message of its plain fields, as JSON, and its body."""
    name, fields = json.loads(text)
    if "body" in fields:
        fields["body"] = body
    if name == "Answer":
        fields["facts"] = Facts(**fields["facts"])
        fields["error"] = fields["error"] and Problem(**fields["error"])
    return MESSAGES[name](**fields)


def _plain(value: Any) -> Any:
    """Of JSON, where it does not know a value: the fields of a message, and nothing of a body."""
    return "" if isinstance(value, bytes) else vars(value)


def _read(source: socket.socket, size: int) -> bytearray:
    """So many bytes; empty where the other side closes before."""
    data = bytearray(size)
    view, done = memoryview(data), 0
    with contextlib.suppress(ConnectionError):
        while done < size and (count := source.recv_into(view[done:])):
            done += count
    return data if done == size else bytearray()
