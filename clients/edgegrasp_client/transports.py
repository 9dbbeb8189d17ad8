"""The two ways to a server, synchronous."""

# ruff: noqa: D102 (the clients say what each method does)

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol

import grpc
import httpx

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc
from edgegrasp_client import grpc_wire, rest_wire
from edgegrasp_client.errors import GraspClientError
from edgegrasp_client.inputs import Given, Inputs
from edgegrasp_client.results import Detection, Model, Scoring
from edgegrasp_client.security import Tls, channel_credentials, ssl_context, token_metadata
from edgegrasp_client.stream import StreamAnswer, StreamRequest


class Transport(Protocol):
    """What a client needs of either; raises GraspClientErrors."""

    def detect(self, inputs: Inputs, options: Mapping[str, Any], timeout: float) -> Detection: ...

    def score(
        self, inputs: Inputs, given: Given, options: Mapping[str, Any], timeout: float
    ) -> Scoring: ...

    def detect_stream(
        self, requests: Iterable[StreamRequest], timeout: float
    ) -> Iterator[StreamAnswer]: ...

    def models(self, timeout: float) -> list[Model]: ...

    def ready(self, timeout: float) -> bool: ...

    def close(self) -> None: ...


def _open_channel(address: str, tls: Tls | None) -> grpc.Channel:
    if tls is None:
        return grpc.insecure_channel(address, grpc_wire.CHANNEL_OPTIONS)
    credentials = channel_credentials(tls)
    return grpc.secure_channel(address, credentials, grpc_wire.CHANNEL_OPTIONS)


class GrpcTransport:
    """A channel."""

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

    def detect_stream(
        self, requests: Iterable[StreamRequest], timeout: float
    ) -> Iterator[StreamAnswer]:
        failed: list[BaseException] = []

        def messages() -> Iterator[grasp_pb2.DetectGraspsStreamRequest]:
            try:
                for number, request in enumerate(requests):
                    yield grpc_wire.stream_message(request, number, timeout)
            except Exception as error:  # gRPC would only log it, in a thread of its own
                failed.append(error)

        call = self._stub.DetectGraspsStream(messages(), metadata=self._metadata)
        try:
            for answer in call:
                yield grpc_wire.stream_answer(answer)
        except grpc.RpcError as error:
            raise grpc_wire.error_from_call(error) from None
        finally:
            call.cancel()  # type: ignore[no-untyped-call]
        if failed:
            raise failed[0]

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


class RestTransport:
    """Connections that are kept open."""

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

    def detect_stream(
        self, requests: Iterable[StreamRequest], timeout: float
    ) -> Iterator[StreamAnswer]:
        for number, request in enumerate(requests):
            post = rest_wire.detect_post(request.inputs, request.options)
            seconds = timeout if request.timeout is None else request.timeout
            try:
                response = self._post(rest_wire.GRASPS, post, seconds)
                detection = rest_wire.detection_from_response(response)
                yield StreamAnswer(request.name(number), detection)
            except GraspClientError as error:
                yield StreamAnswer(request.name(number), error=error)

    def _post(self, path: str, post: dict[str, Any], timeout: float) -> httpx.Response:
        try:
            post = rest_wire.with_deadline(post, timeout)
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
