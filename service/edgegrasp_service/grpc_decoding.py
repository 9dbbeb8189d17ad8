"""Messages that are none, or too long: mistakes of callers, which gRPC takes for the server's."""

from collections.abc import AsyncIterator, Callable
from typing import Any, Self

from google.protobuf.message import DecodeError

from edgegrasp_model.errors import EdgeGraspError, InvalidRequest
from edgegrasp_service.body_limit import too_large

Decode = Callable[[bytes], Any]


class Undecodable:
    """In the place of a message.

    Attributes:
        error: What to tell the caller.
    """

    def __init__(self, error: EdgeGraspError) -> None:
        self.error = error


def tolerant(decode: Decode | None, longest: int | None) -> Decode | None:
    """A decoder that gives back Undecodable where `decode` fails.

    Args:
        decode: None: messages stay bytes.
        longest: Most bytes of a message that is decoded; None: any.
    """
    if decode is None:
        return None

    def read(data: bytes) -> Any:
        if longest is not None and len(data) > longest:
            return Undecodable(too_large(len(data), longest))
        try:
            return decode(data)
        except DecodeError:
            value = f"{len(data)} bytes that are no message of this method"
            fix = "Send a message as the .proto file has it."
            return Undecodable(InvalidRequest("request", value, fix))

    return read


class Decoded:
    """The messages of a stream; raises InvalidRequest in the place of one that is none."""

    def __init__(self, messages: AsyncIterator[Any]) -> None:
        self._messages = messages

    def __aiter__(self) -> Self:
        """Itself."""
        return self

    async def __anext__(self) -> Any:
        """The next message."""
        message = await anext(self._messages)
        if isinstance(message, Undecodable):
            raise message.error
        return message
