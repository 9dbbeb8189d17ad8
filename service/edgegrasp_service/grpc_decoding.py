"""Messages that are none: the caller's mistake, which gRPC takes for one of the server."""

from collections.abc import AsyncIterator, Callable
from typing import Any, Self

from google.protobuf.message import DecodeError

from edgegrasp_model.errors import InvalidRequest

Decode = Callable[[bytes], Any]


class Undecodable:
    """In the place of a message.

    Attributes:
        error: What to tell the caller.
    """

    def __init__(self, size: int) -> None:
        value = f"{size} bytes that are no message of this method"
        self.error = InvalidRequest("request", value, "Send a message as the .proto file has it.")


def tolerant(decode: Decode | None) -> Decode | None:
    """A decoder that gives back Undecodable where `decode` fails; None: messages stay bytes."""
    if decode is None:
        return None

    def read(data: bytes) -> Any:
        try:
            return decode(data)
        except DecodeError:
            return Undecodable(len(data))

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
