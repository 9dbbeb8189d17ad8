"""The client for asyncio; client.py runs it for who does without."""

import asyncio
import time
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Awaitable,
    Callable,
    Iterable,
    Sequence,
)
from functools import partial
from typing import Any, TypeVar

import grpc.aio
import httpx
from typing_extensions import Self, Unpack

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_camera.arrays import Array
from edgegrasp_client import grpc_wire, rest_wire
from edgegrasp_client.clouds import Cloud, DepthImage
from edgegrasp_client.connection import (
    CHANNEL_OPTIONS,
    DEFAULT_ADDRESS,
    HTTP_OVER_UNIX,
    RETRIES,
    Tls,
    channel_credentials,
    is_rest,
    retry_delay,
    ssl_context,
    token_metadata,
)
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    ServerUnavailableError,
    WorkerLostError,
    invalid,
)
from edgegrasp_client.options import DetectOptions
from edgegrasp_client.requests import (
    Request,
    ScoreRequest,
    StreamRequest,
    async_enumerate,
    plain_options,
)
from edgegrasp_client.results import (
    Detection,
    Grasp,
    Model,
    Read,
    Scoring,
    StreamAnswer,
    detection_from,
    models_from,
    scoring_from,
)

POLL_SECONDS = 0.1

Answer = TypeVar("Answer")


class AsyncGraspClient:
    """Asks one server for grasps; use as an async context manager, or close it.

    Args:
        address: "host:port" for gRPC, "http://host:port" or "https://..." for REST; or the socket
            of a server on this machine: "unix:/run/edgegrasp/grpc.sock" for gRPC,
            "http+unix:/run/edgegrasp/http.sock" for REST.
        timeout: Seconds for one call with its retries, unless the call says otherwise; over REST
            for each of connecting, sending and waiting.
        retry: Whether to try again, after short random delays, where the server is away or busy
            or lost the worker of the request. Requests of a stream are sent once.
        token: For a server that asks for one; over TLS, or everyone on the way can read it.
        tls: How to know the server; None: gRPC is not encrypted, and "https://..." trusts the
            authorities that httpx knows.
        http_transport: httpx transport to use instead of the network.
    """

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        timeout: float = 30.0,
        retry: bool = True,
        token: str | None = None,
        tls: Tls | None = None,
        http_transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._timeout = timeout
        self._retry = retry
        self._transport: _GrpcTransport | _RestTransport
        if is_rest(address):
            self._transport = _RestTransport(address, token, tls, http_transport)
        else:
            self._transport = _GrpcTransport(address, token, tls)

    async def detect(
        self,
        cloud: Cloud | None = None,
        *,
        depth_images: Sequence[DepthImage] | None = None,
        normals: Array | None = None,
        colors: Array | None = None,
        segment_ids: Array | None = None,
        view_ids: Array | None = None,
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
        arrays = (normals, colors, segment_ids, view_ids)
        request = Request(cloud, depth_images, *arrays, options=plain_options(options))
        return await self._retried(partial(self._transport.detect, request), timeout)

    async def score(
        self,
        cloud: Cloud | None = None,
        *,
        edges: Array | None = None,
        hand_poses: Array | None = None,
        depth_images: Sequence[DepthImage] | None = None,
        normals: Array | None = None,
        colors: Array | None = None,
        segment_ids: Array | None = None,
        view_ids: Array | None = None,
        timeout: float | None = None,
        **options: Unpack[DetectOptions],
    ) -> Scoring:
        """Score edges or hand poses of one's own: the paper's grasp evaluation function.

        `edges` are (M, 2) integers, approach and contact point, rows of the cloud as sent; in their
        place `hand_poses`, (M, 4, 4) T_cloud_hand. All else is as for `detect`.

        Returns:
            An evaluation for each edge or pose, in their order.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        arrays = (normals, colors, segment_ids, view_ids, plain_options(options))
        request = ScoreRequest(cloud, depth_images, *arrays, edges, hand_poses)
        return await self._retried(partial(self._transport.score, request), timeout)

    def detect_stream(
        self,
        requests: AsyncIterable[StreamRequest] | Iterable[StreamRequest],
        *,
        timeout: float | None = None,
    ) -> AsyncGenerator[StreamAnswer, None]:
        """Find grasps in one cloud after the other, over one stream.

        The next request is sent while earlier ones are at work; where the server is behind, this
        does not run ahead of it. Over REST, each request waits for the answer before it, on one
        connection.

        Args:
            requests: Read as they can be sent; an error in it ends the stream once what went
                before is answered.
            timeout: Seconds for each request that does not say; None: the client's own.

        Yields:
            An answer to each request, in their order; the error of one does not end the stream.

        Raises:
            GraspClientError: The stream itself failed, so that no more answers come.
        """
        return self._transport.detect_stream(async_enumerate(requests), self._seconds(timeout))

    async def models(self, *, timeout: float | None = None) -> list[Model]:
        """The weights that `model` can name.

        Raises:
            GraspClientError: As in edgegrasp_client.errors.
        """
        return await self._retried(self._transport.models, timeout)

    async def record_outcome(
        self, detection: Detection, grasp: Grasp, held: bool, *, timeout: float | None = None
    ) -> None:
        """Tell a server with an `outcomes_file` what became of a grasp of a detection; over REST.

        Raises:
            GraspClientError: As in edgegrasp_client.errors; over gRPC there is no such call.
        """
        tried = {"model": detection.model, "score": float(grasp.score), "held": bool(held)}
        call = partial(self._transport.record_outcome, tried)
        await self._retried(call, timeout)

    async def ready(self, *, timeout: float | None = None) -> bool:
        """Whether the server answers requests: False if it is not there or still loading."""
        return await self._transport.ready(self._seconds(timeout))

    async def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Return once the server answers requests.

        Raises:
            DeadlineError: It did not within `timeout` seconds.
        """
        end = time.monotonic() + timeout
        while not await self.ready(timeout=max(POLL_SECONDS, end - time.monotonic())):
            if time.monotonic() >= end:
                raise DeadlineError(f"The server was not ready within {timeout:g} s.")
            await asyncio.sleep(POLL_SECONDS)

    async def close(self) -> None:
        """Close the connection."""
        self._retry = False  # a call that this cancels has no connection to try again on
        await self._transport.close()

    async def __aenter__(self) -> Self:
        """Itself."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection."""
        await self.close()

    def _seconds(self, timeout: float | None) -> float:
        return self._timeout if timeout is None else timeout

    async def _retried(
        self, call: Callable[[float], Awaitable[Answer]], timeout: float | None
    ) -> Answer:
        """The answer of a call, made again while the server is away or busy and time is left."""
        left = self._seconds(timeout)
        end = time.monotonic() + left
        attempt = 0
        while True:
            try:
                return await call(left)
            except ServerUnavailableError as error:
                delay = retry_delay(error, attempt)
                if not self._retry or delay is None or time.monotonic() + delay >= end:
                    raise
                # A request that a worker died of may be why: one more try.
                attempt += RETRIES if isinstance(error, WorkerLostError) else 1
            await asyncio.sleep(delay)
            left = max(end - time.monotonic(), 0.0)


class _GrpcTransport:
    """Calls over one channel; raises GraspClientErrors."""

    def __init__(self, address: str, token: str | None, tls: Tls | None) -> None:
        if tls is None:
            self._channel = grpc.aio.insecure_channel(address, CHANNEL_OPTIONS)
        else:
            credentials = channel_credentials(tls)
            self._channel = grpc.aio.secure_channel(address, credentials, CHANNEL_OPTIONS)
        self._metadata = token_metadata(token)
        self._stub = grasp_pb2_grpc.GraspServiceStub(self._channel)
        self._check = self._channel.unary_unary(grpc_wire.HEALTH_CHECK, bytes, bytes)

    async def detect(self, request: Request, timeout: float) -> Detection:
        message = grpc_wire.detect_message(request)
        return await self._answer(self._stub.DetectGrasps, message, timeout, detection_from)

    async def score(self, request: ScoreRequest, timeout: float) -> Scoring:
        message = grpc_wire.score_message(request)
        return await self._answer(self._stub.ScoreGrasps, message, timeout, scoring_from)

    async def models(self, timeout: float) -> list[Model]:
        message = grasp_pb2.ListModelsRequest()
        return await self._answer(self._stub.ListModels, message, timeout, models_from)

    async def record_outcome(self, tried: dict[str, Any], timeout: float) -> None:
        raise invalid("address", "gRPC", "Outcomes are taken over REST: give http://host:port.")

    async def _answer(
        self, method: Any, message: Any, timeout: float, parse: Callable[[Any, Read], Answer]
    ) -> Answer:
        try:
            answer = await method(message, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        return parse(answer, grpc_wire.read_field)

    async def detect_stream(
        self, requests: AsyncIterator[tuple[int, StreamRequest]], timeout: float
    ) -> AsyncGenerator[StreamAnswer, None]:
        failed: list[Exception] = []

        async def messages() -> AsyncIterator[grasp_pb2.DetectGraspsStreamRequest]:
            try:
                async for number, request in requests:
                    yield grpc_wire.stream_message(request, number, timeout)
            except Exception as error:  # gRPC reads this elsewhere, and would only log it
                failed.append(error)

        call: Any = self._stub.DetectGraspsStream(messages(), metadata=self._metadata)
        try:
            async for answer in call:
                yield grpc_wire.stream_answer(answer)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        finally:
            call.cancel()
        if failed:
            raise failed[0]

    async def ready(self, timeout: float) -> bool:
        try:
            return bool(await self._check(b"", timeout=timeout) == grpc_wire.SERVING)
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.UNIMPLEMENTED:
                return False
        try:  # a server without gRPC's health service, such as Ray's, answers a request or not
            return bool(await self.models(timeout))
        except GraspClientError:
            return False

    async def close(self) -> None:
        await self._channel.close(None)


class _RestTransport:
    """Posts over connections that are kept open; raises GraspClientErrors."""

    def __init__(
        self,
        address: str,
        token: str | None,
        tls: Tls | None,
        transport: httpx.AsyncBaseTransport | None,
    ) -> None:
        if address.startswith(HTTP_OVER_UNIX):
            transport = httpx.AsyncHTTPTransport(uds=address.removeprefix(HTTP_OVER_UNIX))
            address = "http://localhost"
        self._http = httpx.AsyncClient(
            base_url=address,
            headers=dict(token_metadata(token)),
            verify=ssl_context(tls),
            transport=transport,
        )

    async def detect(self, request: Request, timeout: float) -> Detection:
        return await self._answer(rest_wire.detect_call(request), timeout, detection_from)

    async def score(self, request: ScoreRequest, timeout: float) -> Scoring:
        return await self._answer(rest_wire.score_call(request), timeout, scoring_from)

    async def models(self, timeout: float) -> list[Model]:
        return await self._answer(rest_wire.models_call(), timeout, models_from)

    async def record_outcome(self, tried: dict[str, Any], timeout: float) -> None:
        call = {"method": "POST", "url": "/v1/outcomes", "json": tried}
        await self._answer(call, timeout, lambda _, __: None)

    async def _answer(
        self, call: rest_wire.Call, timeout: float, parse: Callable[[Any, Read], Answer]
    ) -> Answer:
        try:
            response = await self._http.request(**rest_wire.with_deadline(call, timeout))
        except httpx.HTTPError as error:
            raise rest_wire.error_from_transport(error) from None
        return rest_wire.parsed(response, parse)

    async def detect_stream(
        self, requests: AsyncIterator[tuple[int, StreamRequest]], timeout: float
    ) -> AsyncGenerator[StreamAnswer, None]:
        async for number, request in requests:
            call = rest_wire.detect_call(request.request)
            seconds = timeout if request.timeout is None else request.timeout
            try:
                detection = await self._answer(call, seconds, detection_from)
                yield StreamAnswer(request.name(number), detection)
            except GraspClientError as error:
                yield StreamAnswer(request.name(number), error=error)

    async def ready(self, timeout: float) -> bool:
        try:
            return (await self._http.get(rest_wire.READY, timeout=timeout)).is_success
        except httpx.HTTPError:
            return False

    async def close(self) -> None:
        await self._http.aclose()
