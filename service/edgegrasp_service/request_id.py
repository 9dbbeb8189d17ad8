"""What a request is called in answers, logs and traces."""

import re
import uuid
from contextvars import ContextVar

HEADER = "x-request-id"  # of HTTP requests and answers, and in gRPC metadata of both

# Of the request that the running task works on; the edge of each transport sets them.
REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
TRACEPARENT: ContextVar[str] = ContextVar("traceparent", default="")  # W3C trace context

_USABLE = re.compile(r"[\w.:+/=@-]{1,128}", re.ASCII)


def usable_request_id(text: str | None) -> str:
    """The caller's own where it is usable, or else a new one."""
    return text if text is not None and _USABLE.fullmatch(text) else uuid.uuid4().hex
