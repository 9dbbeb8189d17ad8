"""The client, synchronous."""

import time
from collections.abc import Iterable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self, Unpack

import grpc
import httpx
from numpy.typing import NDArray

from edgegrasp_client.cloud_encoding import Cloud
from edgegrasp_client.depth_image import DepthImage
from edgegrasp_client.errors import DeadlineError
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.options import DetectOptions, plain_options
from edgegrasp_client.results import Detection, Model, Scoring
from edgegrasp_client.security import Tls
from edgegrasp_client.stream import StreamAnswer, StreamRequest
from edgegrasp_client.transports import GrpcTransport, RestTransport, Transport

DEFAULT_ADDRESS = "127.0.0.1:50051"
POLL_SECONDS = 0.1


class GraspClient:
    """Asks one server for grasps; use as a context manager, or close it.

    Args:
        address: "host:port" for gRPC, "http://host:port" or "https://..." for REST.
        timeout: Seconds for one call, unless the call says otherwise; over REST for each of
            connecting, sending and waiting.
        token: For a server that asks for one; over TLS, or everyone on the way can read it.
        tls: How to know the server; None: gRPC is not encrypted, and "https://..." trusts the
            authorities that httpx knows.
        channel: gRPC channel to use instead of opening one; its owner closes it.
        http_transport: httpx transport to use instead of the network.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        timeout: float = 30.0,
        token: str | None = None,
        tls: Tls | None = None,
        channel: grpc.Channel | None = None,
        http_transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        self._transport: Transport
        if is_rest(address):
            self._transport = RestTransport(address, token, tls, http_transport)
        else:
            self._transport = GrpcTransport(address, token, tls, channel)

    def detect(
        self,
        cloud: Cloud | None = None,
        *,
        depth_images: Sequence[DepthImage] | None = None,
        normals: NDArray[Any] | None = None,
        colors: NDArray[Any] | None = None,
        segment_ids: NDArray[Any] | None = None,
        view_ids: NDArray[Any] | None = None,
        timeout: float | None = None,
        **options: Unpack[DetectOptions],
    ) -> Detection:
        """Find grasps in a cloud.

        Args:
            cloud: (N, 3) float32 or float64, metres; (H, W, 3) with NaN for holes; the path of a
                .npy, .npz, .ply, .pcd or .xyz file; or an object with the attributes of
                sensor_msgs/PointCloud2.
            depth_images: Views to fuse in place of a cloud; their cameras are the viewpoints, and
                the rows of the cloud their pixels, one image after the other.
            normals: (N, 3), one for each row of the cloud, outward, of any length.
            colors: (N, 3), one for each row.
            segment_ids: (N,) integers, which `segments` of a region name.
            view_ids: (N,) integers: which of several positions of `viewpoint` saw each row.
            timeout: Seconds to wait; None: the client's own.
            options: As in DetectOptions; what is left out takes the server's default.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        inputs = Inputs(cloud, depth_images, normals, colors, segment_ids, view_ids)
        return self._transport.detect(inputs, plain_options(options), self._seconds(timeout))

    def score(
        self,
        cloud: Cloud | None = None,
        *,
        edges: NDArray[Any] | None = None,
        hand_poses: NDArray[Any] | None = None,
        depth_images: Sequence[DepthImage] | None = None,
        normals: NDArray[Any] | None = None,
        colors: NDArray[Any] | None = None,
        segment_ids: NDArray[Any] | None = None,
        view_ids: NDArray[Any] | None = None,
        timeout: float | None = None,
        **options: Unpack[DetectOptions],
    ) -> Scoring:
        """Score edges or hand poses of one's own: the paper's grasp evaluation function.

        Args:
            cloud: As for `detect`, like all that is not said here.
            edges: (M, 2) integers: approach and contact point, rows of the cloud as sent.
            hand_poses: (M, 4, 4) T_cloud_hand, in the place of edges.
            depth_images: As for `detect`.
            normals: As for `detect`.
            colors: As for `detect`.
            segment_ids: As for `detect`.
            view_ids: As for `detect`.
            timeout: As for `detect`.
            options: As for `detect`.

        Returns:
            An evaluation for each edge or pose, in their order.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        inputs = Inputs(cloud, depth_images, normals, colors, segment_ids, view_ids)
        given = Given(edges, hand_poses)
        plain = plain_options(options)
        return self._transport.score(inputs, given, plain, self._seconds(timeout))

    def detect_stream(
        self, requests: Iterable[StreamRequest], *, timeout: float | None = None
    ) -> Iterator[StreamAnswer]:
        """Find grasps in one cloud after the other, over one stream.

        The next request is sent while earlier ones are at work; where the server is behind, this
        does not run ahead of it. Over REST, each request waits for the answer before it, on one
        connection.

        Args:
            requests: Read as they can be sent, by `GraspClient` over gRPC in a thread of its own;
                an error in it ends the stream once what went before is answered.
            timeout: Seconds for each request that does not say; None: the client's own.

        Yields:
            An answer to each request, in their order; the error of one does not end the stream.

        Raises:
            GraspClientError: The stream itself failed, so that no more answers come.
        """
        return self._transport.detect_stream(requests, self._seconds(timeout))

    def models(self, *, timeout: float | None = None) -> list[Model]:
        """The weights that `model` can name.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        return self._transport.models(self._seconds(timeout))

    def ready(self, *, timeout: float | None = None) -> bool:
        """Whether the server answers requests: False if it is not there or still loading."""
        return self._transport.ready(self._seconds(timeout))

    def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Return once the server answers requests.

        Raises:
            DeadlineError: It did not within `timeout` seconds.
        """
        end = time.monotonic() + timeout
        while not self.ready(timeout=max(POLL_SECONDS, end - time.monotonic())):
            if time.monotonic() >= end:
                raise DeadlineError(f"The server was not ready within {timeout:g} s.")
            time.sleep(POLL_SECONDS)

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

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
        self.close()

    def _seconds(self, timeout: float | None) -> float:
        return self._timeout if timeout is None else timeout


def is_rest(address: str) -> bool:
    """Whether an address names the REST transport."""
    return address.startswith(("http://", "https://"))
