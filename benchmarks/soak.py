"""Send a server many requests of every kind: `python -m benchmarks.soak --requests 10000`.

Clouds of 32 to 20,000 points go through a dummy network, over unary gRPC, streams and REST, a few
of them malformed and a few abandoned by their client. Each answer carries the CRC-32 of the cloud
that the server saw, so an answer that belongs to another request is noticed. At the end every
request must have an outcome, the server's memory must not have grown, and it must stop.
"""

import argparse
import io
import json
import os
import queue
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
from benchmarks import dummy
from benchmarks.measuring import RESULTS, Served, served, write_results
from numpy.typing import NDArray

from edgegrasp.v1 import grasp_pb2, grasp_pb2_grpc

ANSWERED = "answered"
REFUSED = "refused"
CANCELLED = "cancelled"
CROSSED = "another cloud's answer"
STUCK = "no answer in time"
EXPECTED = {"good": {ANSWERED}, "malformed": {REFUSED}, "cancelled": {CANCELLED, ANSWERED}}
SECONDS = 30.0  # until a request counts as stuck
STREAM = 8  # requests of one stream
EACH = 2  # clients of each kind
SAMPLES = 100  # of memory
WARM_UP = 0.2  # of the requests: memory grows while pools and caches fill
MAX_SLOPE = 1.0  # MB per 1,000 requests


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


Report = Callable[[Plan, str, str, float], None]  # plan, transport, outcome, seconds
NextPlans = Callable[[int], list[Plan]]


def main() -> None:
    """Send, write soak.json, and fail where anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.environ["DUMMY_SECONDS"] = "0.002"
    with served(program=["-P", dummy.__file__]) as server:
        results = soak(server, plans(given.requests, given.seed), given.requests)
        begun = time.monotonic()
        results["exit_code"] = server.stop()
        results["stop_seconds"] = round(time.monotonic() - begun, 2)
    results["faults"] = faults(results)
    write_results(given.output, "soak", results)
    print(json.dumps({name: results[name] for name in results if name != "memory"}, indent=1))
    sys.exit(1 if results["faults"] else 0)


def plans(requests: int, seed: int) -> Iterator[Plan]:
    """Requests in random order: 90 % good ones, 5 % malformed, 5 % abandoned."""
    random_of = np.random.default_rng(seed)
    for number in range(requests):
        kind = random_of.choice(["good", "malformed", "cancelled"], p=[0.9, 0.05, 0.05])
        size = int(np.exp(random_of.uniform(np.log(32), np.log(20_000))))
        wait = float(random_of.uniform(0.0, 0.01))
        yield Plan(number, str(kind), size, wait, seed)


def soak(server: Served, todo: Iterator[Plan], requests: int) -> dict[str, Any]:
    """Send the plans, from several threads; every plan has an outcome."""
    outcomes: queue.Queue[tuple[Plan, str, str, float]] = queue.Queue()
    lock = threading.Lock()

    def next_plans(count: int) -> list[Plan]:
        with lock:
            return [plan for _, plan in zip(range(count), todo, strict=False)]

    def report(plan: Plan, transport: str, came: str, seconds: float) -> None:
        outcomes.put((plan, transport, came, seconds))

    ways = {
        send_unary: server.grpc_address,
        send_streams: server.grpc_address,
        send_rest: server.http_url,
    }
    threads = [
        threading.Thread(target=send, args=(address, next_plans, report), daemon=True)
        for send, address in ways.items()
        for _ in range(EACH)
    ]
    start = time.monotonic()
    for thread in threads:
        thread.start()
    came: Counter[str] = Counter()
    wrong: list[dict[str, Any]] = []
    memory: list[tuple[int, float]] = []
    slowest = 0.0
    every = max(1, requests // SAMPLES)
    for done in range(1, requests + 1):
        try:
            plan, transport, outcome, seconds = outcomes.get(timeout=60.0)
        except queue.Empty:
            wrong.append({"outcome": f"{requests - done + 1} requests without an outcome"})
            break
        came[f"{transport} {plan.kind}: {outcome}"] += 1
        slowest = max(slowest, seconds)
        if outcome not in EXPECTED[plan.kind]:
            wrong.append({**asdict(plan), "transport": transport, "outcome": outcome})
        if done % every == 0:
            memory.append((done, server.memory()))
    for thread in threads:
        thread.join(timeout=10.0)
    return {
        "requests": requests,
        "seconds": round(time.monotonic() - start, 1),
        "outcomes": dict(sorted(came.items())),
        "wrong": wrong[:20],
        "stuck_clients": sum(thread.is_alive() for thread in threads),
        "slowest_seconds": round(slowest, 3),
        "memory": memory,
        "memory_slope_mb_per_1000": slope(memory, requests),
        "memory_most_mb": round(max(used for _, used in memory), 1),
        "server_threads": server.threads(),
        "server_files": server.files(),
    }


def slope(memory: list[tuple[int, float]], requests: int) -> float:
    """Least squares through the samples after the warm-up, MB per 1,000 requests."""
    after = np.array([sample for sample in memory if sample[0] > WARM_UP * requests])
    if len(after) < 2:
        return 0.0
    return round(float(np.polyfit(after[:, 0] / 1000, after[:, 1], 1)[0]), 4)


def faults(results: dict[str, Any]) -> list[str]:
    """What is wrong; empty: nothing."""
    found = []
    if results["wrong"]:
        found.append("requests with a wrong outcome, or none")
    if results["stuck_clients"] or any(STUCK in name for name in results["outcomes"]):
        found.append("clients that got stuck")
    # The slope of a few requests says nothing.
    if results["requests"] >= 5000 and results["memory_slope_mb_per_1000"] >= MAX_SLOPE:
        found.append("memory grows")
    if results["exit_code"] != 0:
        found.append(f"the server ended with {results['exit_code']}")
    return found


def message(plan: Plan) -> grasp_pb2.DetectGraspsRequest:
    """A request as gRPC carries it; malformed in one of several ways."""
    points, request = plan.points(), grasp_pb2.DetectGraspsRequest
    if plan.kind != "malformed":
        return request(points=points.tobytes())
    holes = np.where(np.arange(len(points))[:, None] == 7, np.float32(np.nan), points)
    return [
        request(),
        request(points=points.tobytes()[:-1]),
        request(points=holes.tobytes()),
        request(encoded=grasp_pb2.EncodedCloud(format="ply", data=points.tobytes())),
        request(points=points.tobytes(), options=grasp_pb2.DetectOptions(seed=-1)),
    ][plan.number % 5]


def outcome(plan: Plan, code: str, digest: int | None) -> str:
    """What came of a request, by its status and the digest in its answer."""
    if code == "OK":
        return ANSWERED if digest == zlib.crc32(plan.points().tobytes()) else CROSSED
    if code == "INVALID_ARGUMENT":
        return REFUSED
    return STUCK if code == "DEADLINE_EXCEEDED" else code


def send_unary(address: str, next_plans: NextPlans, report: Report) -> None:
    """One channel, one call at a time."""
    with grpc.insecure_channel(address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        while plans := next_plans(1):
            start = time.monotonic()
            report(plans[0], "grpc", _unary(stub, plans[0]), time.monotonic() - start)


def _unary(stub: Any, plan: Plan) -> str:
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


def send_streams(address: str, next_plans: NextPlans, report: Report) -> None:
    """One stream after the other, of several requests each."""
    with grpc.insecure_channel(address) as channel:
        stub = grasp_pb2_grpc.GraspServiceStub(channel)
        while plans := next_plans(STREAM):
            # The stream is cancelled with those plans, so they come last.
            plans.sort(key=lambda plan: plan.kind == "cancelled")
            _stream(stub, plans, report)


def _stream(stub: Any, plans: list[Plan], report: Report) -> None:
    start, done = time.monotonic(), threading.Event()

    def requests() -> Iterator[grasp_pb2.DetectGraspsStreamRequest]:
        for plan in plans:
            number, request = str(plan.number), message(plan)
            yield grasp_pb2.DetectGraspsStreamRequest(request_id=number, request=request)
        if plans[-1].kind == "cancelled":  # the stream is still open when its client leaves
            done.wait(SECONDS)

    call = stub.DetectGraspsStream(requests(), timeout=SECONDS)
    for plan in plans:
        if plan.kind == "cancelled":
            time.sleep(plan.wait)
            call.cancel()
            came = CANCELLED
        else:
            try:
                came = _stream_answer(plan, next(call, None))
            except grpc.RpcError as error:
                came = outcome(plan, error.code().name, None)
        report(plan, "stream", came, time.monotonic() - start)
    done.set()


def _stream_answer(plan: Plan, response: grasp_pb2.DetectGraspsStreamResponse | None) -> str:
    if response is None:
        return "the stream ended"
    if response.request_id != str(plan.number):
        return CROSSED
    if response.WhichOneof("answer") == "error":
        codes = {code.value[0]: code.name for code in grpc.StatusCode}
        return outcome(plan, codes[response.error.code], None)
    return outcome(plan, "OK", response.detection.counts["crc32"])


def send_rest(http_url: str, next_plans: NextPlans, report: Report) -> None:
    """One connection that is kept alive, but for requests that are abandoned."""
    with httpx.Client(base_url=http_url, timeout=SECONDS) as client:
        while plans := next_plans(1):
            start = time.monotonic()
            report(plans[0], "rest", _post(client, plans[0]), time.monotonic() - start)


def _post(client: httpx.Client, plan: Plan) -> str:
    body, media_type, query = _body(plan)
    headers = {"Content-Type": media_type, "X-Request-ID": str(plan.number)}
    content: bytes | Iterator[bytes] = body
    timeout = SECONDS
    if plan.kind == "cancelled":
        timeout = max(plan.wait, 1e-4)
        if plan.number % 2 == 0:  # the client leaves half way through the body
            content, headers["Content-Length"] = _half(body), str(len(body))
    try:
        url = f"/v1/grasps{query}"
        response = client.post(url, content=content, headers=headers, timeout=timeout)
    except (httpx.TimeoutException, TimeoutError):
        return CANCELLED if plan.kind == "cancelled" else STUCK
    except httpx.HTTPError as error:
        return type(error).__name__
    if response.headers.get("X-Request-ID") not in (None, str(plan.number)):
        return CROSSED
    if response.status_code == 200:
        return outcome(plan, "OK", response.json()["counts"]["crc32"])
    refused = response.status_code in (400, 415)
    return outcome(plan, "INVALID_ARGUMENT" if refused else str(response.status_code), None)


def _half(body: bytes) -> Iterator[bytes]:
    yield body[: len(body) // 2]
    raise TimeoutError


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


if __name__ == "__main__":
    main()
