"""The client, synchronous."""

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self, Unpack

import grpc
import httpx
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import grpc_wire, rest_wire
from edgegrasp_client.cloud_encoding import Cloud
from edgegrasp_client.depth_image import DepthImage
from edgegrasp_client.errors import DeadlineError
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.options import DetectOptions, plain_options
from edgegrasp_client.results import Detection, Model, Scoring
from edgegrasp_client.security import Tls, channel_credentials, ssl_context, token_metadata

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
        self._transport: _Transport
        if is_rest(address):
            self._transport = _RestTransport(address, token, tls, http_transport)
        else:
            self._transport = _GrpcTransport(address, token, tls, channel)

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


class _Transport(Protocol):
    def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection: ...

    def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring: ...

    def models(self, timeout: float) -> list[Model]: ...

    def ready(self, timeout: float) -> bool: ...

    def close(self) -> None: ...


def _open_channel(address: str, tls: Tls | None) -> grpc.Channel:
    if tls is None:
        return grpc.insecure_channel(address, grpc_wire.CHANNEL_OPTIONS)
    credentials = channel_credentials(tls)
    return grpc.secure_channel(address, credentials, grpc_wire.CHANNEL_OPTIONS)


class _GrpcTransport:
    def __init__(
        self, address: str, token: str | None, tls: Tls | None, channel: grpc.Channel | None
    ) -> None:
        self._owned = channel is None
        self._channel = channel or _open_channel(address, tls)
        self._metadata = token_metadata(token)
        self._stub = grasp_pb2_grpc.GraspServiceStub(self._channel)
        self._check = self._channel.unary_unary(grpc_wire.HEALTH_CHECK, bytes, bytes)

    def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection:
        request = grpc_wire.request_message(inputs, options)
        try:
            answer = self._stub.DetectGrasps(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.detection_from_message(answer)

    def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring:
        request = grpc_wire.score_message(inputs, given, options)
        try:
            answer = self._stub.ScoreGrasps(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.scoring_from_message(answer)

    def models(self, timeout: float) -> list[Model]:
        try:
            request = grasp_pb2.ListModelsRequest()
            answer = self._stub.ListModels(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.models_from_message(answer)

    def ready(self, timeout: float) -> bool:
        try:
            return bool(self._check(b"", timeout=timeout) == grpc_wire.SERVING)
        except grpc.RpcError:
            return False

    def close(self) -> None:
        if self._owned:
            self._channel.close()


class _RestTransport:
    def __init__(
        self,
        address: str,
        token: str | None,
        tls: Tls | None,
        transport: httpx.BaseTransport | None,
    ) -> None:
        self._http = httpx.Client(
            base_url=address,
            headers=dict(token_metadata(token)),
            verify=ssl_context(tls),
            transport=transport,
        )

    def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection:
        post = rest_wire.detect_post(inputs, options)
        response = self._post(rest_wire.GRASPS, post, timeout)
        return rest_wire.detection_from_response(response)

    def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring:
        post = rest_wire.score_post(inputs, given, options)
        response = self._post(rest_wire.SCORE, post, timeout)
        return rest_wire.scoring_from_response(response)

    def _post(self, path: str, post: dict[str, Any], timeout: float) -> httpx.Response:
        try:
            return self._http.post(path, **post, timeout=timeout)
        except httpx.HTTPError as error:
            raise rest_wire.error_from_transport(error) from None

    def models(self, timeout: float) -> list[Model]:
        try:
            response = self._http.get(rest_wire.MODELS, timeout=timeout)
        except httpx.HTTPError as error:
            raise rest_wire.error_from_transport(error) from None
        return rest_wire.models_from_response(response)

    def ready(self, timeout: float) -> bool:
        try:
            return self._http.get(rest_wire.READY, timeout=timeout).is_success
        except httpx.HTTPError:
            return False

    def close(self) -> None:
        self._http.close()
