"""One request on its way through the server: who asks, until when, and what became of it."""

import re
import time
import uuid
from contextvars import ContextVar
from dataclasses import dataclass, field

from edgegrasp_service.errors import Problem
from edgegrasp_service.worker.job import Facts, Transport

REQUEST_ID_HEADER = "x-request-id"  # of HTTP requests and answers, and in gRPC metadata of both

_USABLE_ID = re.compile(r"[\w.:+/=@-]{1,128}", re.ASCII)


@dataclass
class Call:
    """One request, or one stream of them."""

    transport: Transport
    method: str  # the gRPC method's name, for either transport
    request_id: str = ""  # the caller's own where it is usable, or else a new one
    peer: str = ""  # address without port
    token: str = ""  # name of the token it came with
    is_admin: bool = False
    traceparent: str = ""  # W3C trace context, as sent
    long: bool = False  # a stream, whose duration says nothing
    in_stream: bool = False  # one request of a stream
    start: float = field(default_factory=time.monotonic)  # as the event loop's clock
    deadline: float = float("inf")
    bytes_in: int = 0
    bytes_out: int = 0
    code: str = ""  # it ended with: a gRPC code or an HTTP status
    problem: Problem | None = None
    facts: Facts = field(default_factory=Facts)
    stages: dict[str, float] = field(default_factory=dict)  # seconds of each, in order
    seconds: float = 0.0  # from its start to its end

    def __post_init__(self) -> None:
        if not _USABLE_ID.fullmatch(self.request_id):
            self.request_id = uuid.uuid4().hex

    @property
    def client(self) -> str:
        """Whom its requests count for."""
        return self.token or self.peer

    def limit(self, timeout: float) -> None:
        """Bring the deadline forward to `timeout` seconds after the start, if it is later."""
        self.deadline = min(self.deadline, self.start + timeout)

    def end_stage(self, name: str) -> None:
        """Note that a stage ended now, which began where the one before it ended."""
        self.stages[name] = time.monotonic() - self.start - sum(self.stages.values())


CALL: ContextVar[Call | None] = ContextVar("call", default=None)  # of the running task


def current_call() -> Call:
    """The call that the running task works on."""
    call = CALL.get()
    assert call is not None, "outside of the middleware"
    return call
