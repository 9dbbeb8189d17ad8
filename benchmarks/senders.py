"""The least that a client can do: one packed cloud over one connection, and what came of it."""

import http.client
import io
import json
import time
import urllib.parse
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import grpc
import numpy as np
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc

CHANNEL_OPTIONS = (
    ("grpc.max_send_message_length", -1),
    ("grpc.max_receive_message_length", -1),
    ("grpc.use_local_subchannel_pool", 1),  # a connection for each channel
)
LOST = "LOST"  # the connection ended without an answer
TIMEOUT = "X-Request-Timeout"
STATUS = {
    200: "OK", 400: "INVALID_ARGUMENT", 413: "RESOURCE_EXHAUSTED", 429: "RESOURCE_EXHAUSTED",
    500: "INTERNAL", 503: "UNAVAILABLE", 504: "DEADLINE_EXCEEDED",
}  # fmt: skip


@dataclass(frozen=True)
class Told:
    """What came of a request."""

    code: str  # as gRPC names it
    digest: int = 0  # the dummy's, of the cloud it saw


class Sender(Protocol):
    """Sends a cloud and waits."""

    def send(self, timeout: float | None) -> Told:
        """Send the cloud it was made with."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: Any) -> None: ...


class GrpcSender:
    """Packed float32 in a message, made once."""

    def __init__(self, address: str, points: NDArray[np.float32], options: dict[str, int]) -> None:
        self._channel = grpc.insecure_channel(address, CHANNEL_OPTIONS)
        self._detect = grasp_pb2_grpc.GraspServiceStub(self._channel).DetectGrasps
        self._request = grasp_pb2.DetectGraspsRequest(
            points=points.astype("<f4").tobytes(), options=grasp_pb2.DetectOptions(**options)
        )

    def send(self, timeout: float | None) -> Told:
        """Send the cloud."""
        try:
            answer = self._detect(self._request, timeout=timeout)
        except grpc.RpcError as error:
            return Told(error.code().name)
        return Told("OK", answer.counts.get("crc32", 0))

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the channel."""
        self._channel.close()


class RestSender:
    """An .npy file as body, over one connection that is kept alive."""

    def __init__(self, address: str, points: NDArray[np.float32], options: dict[str, int]) -> None:
        self._host = urllib.parse.urlsplit(address).netloc
        self._connection = http.client.HTTPConnection(self._host)
        stream = io.BytesIO()
        np.save(stream, points)
        self._body = stream.getvalue()
        self._path = "/v1/grasps?" + urllib.parse.urlencode(options)

    def send(self, timeout: float | None) -> Told:
        """Send the cloud."""
        headers = {"Content-Type": "application/x-npy"}
        if timeout is not None:
            headers[TIMEOUT] = repr(timeout)
        try:
            self._connection.request("POST", self._path, self._body, headers)
            response = self._connection.getresponse()
            content = response.read()
        except (http.client.HTTPException, OSError):
            self._connection.close()  # the next request opens it anew
            return Told(LOST)
        if response.status != 200:
            return Told(STATUS.get(response.status, str(response.status)))
        answer = json.loads(content)
        return Told("OK", answer["counts"].get("crc32", 0))

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connection."""
        self._connection.close()


def sender(
    transport: str, address: str, points: NDArray[np.float32], options: dict[str, int]
) -> GrpcSender | RestSender:
    """The sender of a transport, "grpc" or "rest"."""
    return (GrpcSender if transport == "grpc" else RestSender)(address, points, options)


def cloud(points: int, seed: int) -> NDArray[np.float32]:
    """(N, 3) metres: a table of 0.3 m with five boxes on it, seen from all sides."""
    random = np.random.default_rng([seed, points])
    table = random.uniform((0.0, 0.0, 0.0), (0.3, 0.3, 0.001), (points // 3, 3))
    boxes = []
    rest = points - len(table)
    for row in range(5):
        count = rest // 5 if row < 4 else rest - 4 * (rest // 5)
        corner = random.uniform((0.02, 0.02, 0.001), (0.22, 0.22, 0.001))
        size = random.uniform(0.02, 0.06, 3)
        inside = random.uniform(0.0, 1.0, (count, 3))
        face = random.integers(0, 3, count)
        inside[np.arange(count), face] = random.integers(0, 2, count)
        boxes.append(corner + inside * size)
    return np.concatenate([table, *boxes]).astype(np.float32)


def wait_until(moment: float) -> None:
    """Sleep until a moment of time.monotonic, which processes of one machine share."""
    if (left := moment - time.monotonic()) > 0:
        time.sleep(left)
