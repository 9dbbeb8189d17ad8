"""Exceptions of the client, the same over both transports; all are GraspClientErrors."""


class GraspClientError(Exception):
    """Base of every error that the client raises on purpose."""


class InvalidRequestError(GraspClientError):
    """The cloud or an option is wrong.

    `field` is of the request, e.g. "options.seed", empty if unknown; `value` what the server
    received, and `fix` what to send instead, in words.
    """

    def __init__(self, message: str, field: str = "", value: str = "", fix: str = "") -> None:
        super().__init__(message)
        self.field = field
        self.value = value
        self.fix = fix


class UnknownModelError(InvalidRequestError):
    """The server has no weights of that name."""


class StartCollisionError(InvalidRequestError):
    """With the request's joints, the arm collides with itself or with the scene."""


class PayloadTooLargeError(InvalidRequestError):
    """The request exceeds the server's limits."""


class AccessDeniedError(GraspClientError):
    """The server requires a token, and it is missing, unknown or without the needed permission."""


class ServerUnavailableError(GraspClientError):
    """No connection, a server that is loading or stopping, or a lost request; retrying may help."""


class OverloadedError(ServerUnavailableError):
    """The server is full, for `retry_after` seconds."""

    def __init__(self, message: str, retry_after: float = 1.0) -> None:
        super().__init__(message)
        self.retry_after = retry_after


class WorkerLostError(ServerUnavailableError):
    """The worker process of the request died or was killed; the client retries once."""


class DeadlineError(GraspClientError):
    """There was no answer within the timeout."""


class ServerFailedError(GraspClientError):
    """The server failed on a good request; its log says why."""


class ProtocolError(GraspClientError):
    """The answer is not from a grasp service; the address may belong to another service."""
