"""The client, for asyncio."""

import asyncio
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self, Unpack

import grpc
import httpx
from grpc import aio
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import grpc_wire, rest_wire
from edgegrasp_client.client import DEFAULT_ADDRESS, POLL_SECONDS, is_rest
from edgegrasp_client.cloud_encoding import Cloud
from edgegrasp_client.depth_image import DepthImage
from edgegrasp_client.errors import DeadlineError
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.options import DetectOptions, plain_options
from edgegrasp_client.results import Detection, Model, Scoring
from edgegrasp_client.security import Tls, channel_credentials, ssl_context, token_metadata


class AsyncGraspClient:
    """Asks one server for grasps; use as an async context manager, or close it.

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
        channel: aio.Channel | None = None,
        http_transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        self._transport: _Transport
        if is_rest(address):
            self._transport = _RestTransport(address, token, tls, http_transport)
        else:
            self._transport = _GrpcTransport(address, token, tls, channel)

    async def detect(
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
        return await self._transport.detect(inputs, plain_options(options), self._seconds(timeout))

    async def score(
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
        return await self._transport.score(inputs, given, plain, self._seconds(timeout))

    async def models(self, *, timeout: float | None = None) -> list[Model]:
        """The weights that `model` can name.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        return await self._transport.models(self._seconds(timeout))

    async def ready(self, *, timeout: float | None = None) -> bool:
        """Whether the server answers requests: False if it is not there or still loading."""
        return await self._transport.ready(self._seconds(timeout))

    async def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Return once the server answers requests.

        Raises:
            DeadlineError: It did not within `timeout` seconds.
        """
        loop = asyncio.get_running_loop()
        end = loop.time() + timeout
        while not await self.ready(timeout=max(POLL_SECONDS, end - loop.time())):
            if loop.time() >= end:
                raise DeadlineError(f"The server was not ready within {timeout:g} s.")
            await asyncio.sleep(POLL_SECONDS)

    async def close(self) -> None:
        """Close the connection."""
        await self._transport.close()

    async def __aenter__(self) -> Self:
        """Itself."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connection."""
        await self.close()

    def _seconds(self, timeout: float | None) -> float:
        return self._timeout if timeout is None else timeout


class _Transport(Protocol):
    async def detect(
        self, inputs: Inputs, options: Mapping[str, Any], timeout: float
    ) -> Detection: ...

    async def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring: ...

    async def models(self, timeout: float) -> list[Model]: ...

    async def ready(self, timeout: float) -> bool: ...

    async def close(self) -> None: ...


def _open_channel(address: str, tls: Tls | None) -> aio.Channel:
    if tls is None:
        return aio.insecure_channel(address, grpc_wire.CHANNEL_OPTIONS)
    credentials = channel_credentials(tls)
    return aio.secure_channel(address, credentials, grpc_wire.CHANNEL_OPTIONS)


class _GrpcTransport:
    def __init__(
        self, address: str, token: str | None, tls: Tls | None, channel: aio.Channel | None
    ) -> None:
        self._owned = channel is None
        self._channel = channel or _open_channel(address, tls)
        self._metadata = token_metadata(token)
        self._stub = grasp_pb2_grpc.GraspServiceStub(self._channel)
        self._check = self._channel.unary_unary(grpc_wire.HEALTH_CHECK, bytes, bytes)

    async def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection:
        request = grpc_wire.request_message(inputs, options)
        try:
            answer = await self._stub.DetectGrasps(
                request, timeout=timeout, metadata=self._metadata
            )
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.detection_from_message(answer)

    async def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring:
        request = grpc_wire.score_message(inputs, given, options)
        try:
            answer = await self._stub.ScoreGrasps(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.scoring_from_message(answer)

    async def models(self, timeout: float) -> list[Model]:
        try:
            request = grasp_pb2.ListModelsRequest()
            answer = await self._stub.ListModels(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return grpc_wire.models_from_message(answer)

    async def ready(self, timeout: float) -> bool:
        try:
            return bool(await self._check(b"", timeout=timeout) == grpc_wire.SERVING)
        except grpc.RpcError:
            return False

    async def close(self) -> None:
        if self._owned:
            await self._channel.close(None)


class _RestTransport:
    def __init__(
        self,
        address: str,
        token: str | None,
        tls: Tls | None,
        transport: httpx.AsyncBaseTransport | None,
    ) -> None:
        self._http = httpx.AsyncClient(
            base_url=address,
            headers=dict(token_metadata(token)),
            verify=ssl_context(tls),
            transport=transport,
        )

    async def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection:
        post = rest_wire.detect_post(inputs, options)
        response = await self._post(rest_wire.GRASPS, post, timeout)
        return rest_wire.detection_from_response(response)

    async def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring:
        post = rest_wire.score_post(inputs, given, options)
        response = await self._post(rest_wire.SCORE, post, timeout)
        return rest_wire.scoring_from_response(response)

    async def _post(self, path: str, post: dict[str, Any], timeout: float) -> httpx.Response:
        try:
            return await self._http.post(path, **post, timeout=timeout)
        except httpx.HTTPError as error:
            raise rest_wire.error_from_transport(error) from None

    async def models(self, timeout: float) -> list[Model]:
        try:
            response = await self._http.get(rest_wire.MODELS, timeout=timeout)
        except httpx.HTTPError as error:
            raise rest_wire.error_from_transport(error) from None
        return rest_wire.models_from_response(response)

    async def ready(self, timeout: float) -> bool:
        try:
            return (await self._http.get(rest_wire.READY, timeout=timeout)).is_success
        except httpx.HTTPError:
            return False

    async def close(self) -> None:
        await self._http.aclose()
