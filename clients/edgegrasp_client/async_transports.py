"""The two ways to a server, for asyncio."""

# ruff: noqa: D102 (the clients say what each method does)

from collections.abc import AsyncIterable, AsyncIterator, Mapping
from typing import Any, Protocol

import grpc
import httpx
from grpc import aio

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import grpc_wire, rest_wire
from edgegrasp_client.errors import GraspClientError
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.results import Detection, Model, Scoring
from edgegrasp_client.security import Tls, channel_credentials, ssl_context, token_metadata
from edgegrasp_client.stream import StreamAnswer, StreamRequest


class Transport(Protocol):
    """What a client needs of either; raises GraspClientErrors."""

    async def detect(
        self, inputs: Inputs, options: Mapping[str, Any], timeout: float
    ) -> Detection: ...

    async def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring: ...

    def detect_stream(
        self, requests: AsyncIterable[StreamRequest], timeout: float
    ) -> AsyncIterator[StreamAnswer]: ...

    async def models(self, timeout: float) -> list[Model]: ...

    async def ready(self, timeout: float) -> bool: ...

    async def close(self) -> None: ...


def _open_channel(address: str, tls: Tls | None) -> aio.Channel:
    if tls is None:
        return aio.insecure_channel(address, grpc_wire.CHANNEL_OPTIONS)
    credentials = channel_credentials(tls)
    return aio.secure_channel(address, credentials, grpc_wire.CHANNEL_OPTIONS)


class GrpcTransport:
    """A channel."""

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

    async def detect_stream(
        self, requests: AsyncIterable[StreamRequest], timeout: float
    ) -> AsyncIterator[StreamAnswer]:
        failed: list[BaseException] = []

        async def messages() -> AsyncIterator[grasp_pb2.DetectGraspsStreamRequest]:
            number = 0
            try:
                async for request in requests:
                    yield grpc_wire.stream_message(request, number, timeout)
                    number += 1
            except Exception as error:  # gRPC would only log it, in a task of its own
                failed.append(error)

        call = self._stub.DetectGraspsStream(messages(), metadata=self._metadata)
        try:
            async for answer in call:
                yield grpc_wire.stream_answer(answer)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        finally:
            call.cancel()
        if failed:
            raise failed[0]

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


class RestTransport:
    """Connections that are kept open."""

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

    async def detect_stream(
        self, requests: AsyncIterable[StreamRequest], timeout: float
    ) -> AsyncIterator[StreamAnswer]:
        number = 0
        async for request in requests:
            post = rest_wire.detect_post(request.inputs, request.options)
            seconds = timeout if request.timeout is None else request.timeout
            try:
                response = await self._post(rest_wire.GRASPS, post, seconds)
                detection = rest_wire.detection_from_response(response)
                yield StreamAnswer(request.name(number), detection)
            except GraspClientError as error:
                yield StreamAnswer(request.name(number), error=error)
            number += 1

    async def _post(self, path: str, post: dict[str, Any], timeout: float) -> httpx.Response:
        try:
            post = rest_wire.with_deadline(post, timeout)
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
