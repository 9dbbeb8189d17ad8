"""Clients of benchmarks/soak.py: good ones, careless ones, and those that leave."""

import http.client
import io
import json
import queue
import socket
import time
import urllib.parse
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import grpc
import numpy as np
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc

ANSWERED = "answered"
REFUSED = "refused"
CANCELLED = "cancelled"
CROSSED = "another cloud's answer"
STUCK = "no answer in time"
SECONDS = 30.0  # until a request counts as stuck
STREAM = 8  # requests of one stream

Report = Callable[[tuple["Plan", str, str, float]], None]
NextPlans = Callable[[int], list["Plan"]]


@dataclass(frozen=True)
class Plan:
    """One request."""

    number: int
    kind: str  # good, malformed or cancelled
    size: int  # points
    wait: float  # seconds until its client leaves
    seed: int

    def points(self) -> NDArray[np.float32]:
        """(N, 3) a cloud that no other plan has."""
        random = np.random.default_rng([self.seed, self.number])
        return random.uniform(-0.2, 0.2, (self.size, 3)).astype(np.float32)


class Client(Protocol):
    """Sends one plan after the other, and reports what came of each."""

    def work(self, next_plans: NextPlans, report: Report) -> None:
        """Until there are no plans left."""


def clients(http_url: str, grpc_address: str) -> Iterator[Client]:
    """Two of each kind."""
    for _ in range(2):
        yield UnaryClient(grpc_address)
        yield StreamClient(grpc_address)
        yield RestClient(http_url)


def message(plan: Plan) -> grasp_pb2.DetectGraspsRequest:
    """A request as gRPC carries it; malformed in one of several ways."""
    points = plan.points()
    if plan.kind == "malformed":
        match plan.number % 5:
            case 0:
                return grasp_pb2.DetectGraspsRequest()
            case 1:
                return grasp_pb2.DetectGraspsRequest(points=points.tobytes()[:-1])
            case 2:
                points[-1] = np.nan
            case 3:
                file = grasp_pb2.EncodedCloud(format="ply", data=points.tobytes())
                return grasp_pb2.DetectGraspsRequest(encoded=file)
            case _:
                options = grasp_pb2.DetectOptions(seed=-1)
                return grasp_pb2.DetectGraspsRequest(points=points.tobytes(), options=options)
    return grasp_pb2.DetectGraspsRequest(points=points.tobytes())


def outcome(plan: Plan, code: str, digest: int | None) -> str:
    """What came of a request, by its status and the digest in its answer."""
    if code == "OK":
        return ANSWERED if digest == zlib.crc32(plan.points().tobytes()) else CROSSED
    if code == "INVALID_ARGUMENT":
        return REFUSED
    return STUCK if code == "DEADLINE_EXCEEDED" else code


class UnaryClient:
    """One channel, one call at a time."""

    def __init__(self, address: str) -> None:
        self._address = address

    def work(self, next_plans: NextPlans, report: Report) -> None:
        """Send plans."""
        with grpc.insecure_channel(self._address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            while plans := next_plans(1):
                start = time.monotonic()
                came = self._send(stub, plans[0])
                report((plans[0], "grpc", came, time.monotonic() - start))

    def _send(self, stub: Any, plan: Plan) -> str:
        call = stub.DetectGrasps.future(message(plan), timeout=SECONDS)
        if plan.kind == "cancelled":
            time.sleep(plan.wait)
            call.cancel()
        try:
            answer = call.result()
        except grpc.FutureCancelledError:
            return CANCELLED
        except grpc.RpcError as error:
            return outcome(plan, error.code().name, None)
        return outcome(plan, "OK", answer.counts["crc32"])


class StreamClient:
    """One stream after the other, of several requests each."""

    def __init__(self, address: str) -> None:
        self._address = address

    def work(self, next_plans: NextPlans, report: Report) -> None:
        """Send plans."""
        with grpc.insecure_channel(self._address) as channel:
            stub = grasp_pb2_grpc.GraspServiceStub(channel)
            while plans := next_plans(STREAM):
                # The stream is cancelled with those plans, so they come last.
                plans.sort(key=lambda plan: plan.kind == "cancelled")
                self._stream(stub, plans, report)

    def _stream(self, stub: Any, plans: list[Plan], report: Report) -> None:
        start = time.monotonic()
        to_send: queue.SimpleQueue[Plan | None] = queue.SimpleQueue()
        for plan in plans:
            to_send.put(plan)
        left = [plan for plan in plans if plan.kind == "cancelled"]
        if not left:
            to_send.put(None)
        call = stub.DetectGraspsStream(_requests(to_send), timeout=SECONDS)
        unanswered = plans[: len(plans) - len(left)]
        try:
            while unanswered:
                came = self._answer(unanswered[0], next(call, None))
                report((unanswered.pop(0), "stream", came, time.monotonic() - start))
            if not left and next(call, None) is not None:
                report((plans[-1], "stream", "an answer too many", time.monotonic() - start))
        except grpc.RpcError as error:
            for plan in unanswered:
                came = outcome(plan, error.code().name, None)
                report((plan, "stream", came, time.monotonic() - start))
        if left:
            time.sleep(left[0].wait)
            call.cancel()
            to_send.put(None)
        for plan in left:
            report((plan, "stream", CANCELLED, time.monotonic() - start))

    def _answer(self, plan: Plan, response: grasp_pb2.DetectGraspsStreamResponse | None) -> str:
        if response is None:
            return "the stream ended"
        if response.request_id != str(plan.number):
            return CROSSED
        if response.WhichOneof("answer") == "error":
            codes = {code.value[0]: code.name for code in grpc.StatusCode}
            return outcome(plan, codes[response.error.code], None)
        return outcome(plan, "OK", response.detection.counts["crc32"])


def _requests(
    to_send: "queue.SimpleQueue[Plan | None]",
) -> Iterator[grasp_pb2.DetectGraspsStreamRequest]:
    while (plan := to_send.get()) is not None:
        yield grasp_pb2.DetectGraspsStreamRequest(
            request_id=str(plan.number), request=message(plan)
        )


class RestClient:
    """One connection that is kept alive, and one more for each request that is abandoned."""

    def __init__(self, http_url: str) -> None:
        self._host = urllib.parse.urlsplit(http_url).netloc

    def work(self, next_plans: NextPlans, report: Report) -> None:
        """Send plans."""
        connection = http.client.HTTPConnection(self._host, timeout=SECONDS)
        while plans := next_plans(1):
            start = time.monotonic()
            if plans[0].kind == "cancelled":
                came = self._leave(plans[0])
            else:
                try:
                    came = self._send(connection, plans[0])
                except TimeoutError:
                    came = STUCK
                except (http.client.HTTPException, OSError) as error:
                    connection.close()
                    came = f"{type(error).__name__}"
            report((plans[0], "rest", came, time.monotonic() - start))
        connection.close()

    def _send(self, connection: http.client.HTTPConnection, plan: Plan) -> str:
        body, media_type, query = _body(plan)
        headers = {"Content-Type": media_type, "X-Request-ID": str(plan.number)}
        connection.request("POST", f"/v1/grasps{query}", body, headers)
        response = connection.getresponse()
        content = json.loads(response.read())
        if response.getheader("X-Request-ID") not in (None, str(plan.number)):
            return CROSSED
        if response.status == 200:
            return outcome(plan, "OK", content["counts"]["crc32"])
        refused = response.status in (400, 415)
        return outcome(plan, "INVALID_ARGUMENT" if refused else str(response.status), None)

    def _leave(self, plan: Plan) -> str:
        """Close the connection half way through the body, or before the answer."""
        body, media_type, _ = _body(plan)
        head = f"POST /v1/grasps HTTP/1.1\r\nHost: {self._host}\r\nContent-Type: {media_type}\r\n"
        head += f"Content-Length: {len(body)}\r\n\r\n"
        sent = body if plan.number % 2 else body[: len(body) // 2]
        host, _, port = self._host.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=SECONDS) as connection:
            connection.sendall(head.encode() + sent)
            time.sleep(plan.wait)
        return CANCELLED


def _body(plan: Plan) -> tuple[bytes, str, str]:
    """A request as HTTP carries it: body, media type, query; malformed in one of several ways."""
    points = plan.points()
    stream = io.BytesIO()
    np.save(stream, points)
    npy = stream.getvalue()
    if plan.kind == "malformed":
        return [
            (npy[:-5], "application/x-npy", ""),
            (npy, "application/x-pcd", ""),
            (b'{"points": [[0, 0', "application/json", ""),
            (npy, "text/plain", ""),
            (npy, "application/x-npy", "?sead=1"),
        ][plan.number % 5]
    if plan.number % 4 == 0:
        return json.dumps({"points": points.tolist()}).encode(), "application/json", ""
    return npy, "application/x-npy", ""
