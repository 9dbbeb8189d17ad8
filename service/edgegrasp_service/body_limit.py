"""Refuse large bodies while they arrive."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from edgegrasp_service.errors import PayloadTooLarge

# A client that is still sending does not read its answer, so this much more is read and dropped.
MAX_DROPPED_BYTES = 64 * 2**20


class BodyLimit:
    """Middleware that raises PayloadTooLarge out of `receive` once a body exceeds the limit."""

    def __init__(self, app: ASGIApp, max_body_bytes: int) -> None:
        self._app = app
        self._max = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application with a counting `receive`."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        received = 0

        async def counting_receive() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._max:
                raise too_large(await self._drop(message, received, receive), self._max)
            return message

        await self._app(scope, counting_receive, send)

    async def _drop(self, message: Message, received: int, receive: Receive) -> int:
        """Read the rest of the body; gives back how much there was."""
        while message.get("more_body", False) and received <= self._max + MAX_DROPPED_BYTES:
            message = await receive()
            received += len(message.get("body", b""))
        return received


def too_large(size: int, max_body_bytes: int) -> PayloadTooLarge:
    """The error for a body of a size."""
    return PayloadTooLarge(
        "body",
        f"{size} bytes",
        f"Send at most {max_body_bytes} bytes, e.g. float32 points or a downsampled cloud.",
    )
