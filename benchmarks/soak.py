"""Send a server many requests of every kind: `python -m benchmarks.soak --requests 10000`.

Clouds of 32 to 20,000 points go through a dummy network, over unary gRPC, streams and REST, a few
of them malformed and a few abandoned by their client. Each answer carries the CRC-32 of the cloud
that the server saw, so an answer that belongs to another request is noticed. At the end every
request must have an outcome, the server's memory must not have grown, and it must stop.
"""

import argparse
import asyncio
import json
import os
import sys
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import dummy
from benchmarks.measuring import RESULTS, Served, served, write_results
from numpy.typing import NDArray

from edgegrasp_client import (
    AsyncGraspClient,
    Detection,
    GraspClientError,
    InvalidRequestError,
    StreamRequest,
)

ANSWERED = "answered"
REFUSED = "refused"
CANCELLED = "cancelled"
CROSSED = "another cloud's answer"
EXPECTED = {"good": {ANSWERED}, "malformed": {REFUSED}, "cancelled": {CANCELLED, ANSWERED}}
SECONDS = 30.0  # until a request counts as stuck
TOGETHER = 8  # requests of one stream
EACH = 2  # clients of each kind
SAMPLES = 100  # of memory
WARM_UP = 0.2  # of the requests: memory grows while pools and caches fill
MAX_SLOPE = 1.0  # MB per 1,000 requests
FAULTS: tuple[dict[str, Any], ...] = ({"seed": -1}, {"model": "none"}, {"viewpoint": [1e300, 0, 0]})


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

    def options(self) -> Any:
        """Of the request; malformed in one of several ways."""
        return FAULTS[self.number % len(FAULTS)] if self.kind == "malformed" else {}


def main() -> None:
    """Send, write soak.json, and fail where anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.environ["DUMMY_SECONDS"] = "0.002"
    with served(program=["-P", dummy.__file__]) as server:
        soak = Soak(server, given.requests, given.seed)
        results = asyncio.run(soak.run())
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


class Soak:
    """Sends plans from several clients at a time, and notes what becomes of each."""

    def __init__(self, server: Served, requests: int, seed: int) -> None:
        self._server, self._requests = server, requests
        self._todo = plans(requests, seed)
        self._came: Counter[str] = Counter()
        self._wrong: list[dict[str, Any]] = []
        self._memory: list[tuple[int, float]] = []
        self._slowest = 0.0

    async def run(self) -> dict[str, Any]:
        """Send all; the figures."""
        start = time.monotonic()
        ways = ((self._server.grpc_address, 1), (self._server.grpc_address, TOGETHER))
        ways += ((self._server.http_url, 1),)
        await asyncio.gather(*(self._send(*way) for way in ways for _ in range(EACH)))
        return {
            "requests": self._requests,
            "seconds": round(time.monotonic() - start, 1),
            "outcomes": dict(sorted(self._came.items())),
            "wrong": self._wrong[:20],
            "slowest_seconds": round(self._slowest, 3),
            "memory": self._memory,
            "memory_slope_mb_per_1000": slope(self._memory, self._requests),
            "memory_most_mb": round(max(used for _, used in self._memory), 1),
            "server_threads": self._server.threads(),
            "server_files": self._server.files(),
        }

    async def _send(self, address: str, together: int) -> None:
        """Plans one after the other, or so many of them `together` in a stream."""
        way = "stream" if together > 1 else "rest" if address.startswith("http") else "grpc"
        async with AsyncGraspClient(address, timeout=SECONDS, retry=False) as client:
            while some := list(islice(self._todo, together)):
                if together > 1:
                    await self._stream(client, some)
                    continue
                start = time.monotonic()
                self._note(way, some[0], await self._one(client, some[0]), start)

    async def _one(self, client: AsyncGraspClient, plan: Plan) -> str:
        work = client.detect(plan.points(), **plan.options())
        try:
            async with asyncio.timeout(plan.wait if plan.kind == "cancelled" else None):
                return outcome(plan, await work)
        except TimeoutError:
            return CANCELLED
        except GraspClientError as error:
            return outcome(plan, error)

    async def _stream(self, client: AsyncGraspClient, some: list[Plan]) -> None:
        # The stream is left with the plans that are cancelled, so they come last.
        some.sort(key=lambda plan: plan.kind == "cancelled")
        requests = [
            StreamRequest(plan.points(), request_id=str(plan.number), **plan.options())
            for plan in some
        ]
        answers, start = client.detect_stream(requests), time.monotonic()
        for plan in some:
            if plan.kind == "cancelled":
                came = CANCELLED
            else:
                answer = await anext(answers)
                came = outcome(plan, answer.error or answer.result())
                came = came if answer.request_id == str(plan.number) else CROSSED
            self._note("stream", plan, came, start)
        await answers.aclose()

    def _note(self, way: str, plan: Plan, came: str, start: float) -> None:
        self._came[f"{way} {plan.kind}: {came}"] += 1
        self._slowest = max(self._slowest, time.monotonic() - start)
        if came not in EXPECTED[plan.kind]:
            self._wrong.append({**asdict(plan), "transport": way, "outcome": came})
        if (done := self._came.total()) % max(1, self._requests // SAMPLES) == 0:
            self._memory.append((done, self._server.memory()))


def outcome(plan: Plan, came: Detection | GraspClientError) -> str:
    """What came of a request, by the digest in its answer or by its error."""
    if isinstance(came, Detection):
        mine = came.counts["crc32"] == zlib.crc32(plan.points().tobytes())
        return ANSWERED if mine else CROSSED
    return REFUSED if isinstance(came, InvalidRequestError) else type(came).__name__


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
        found.append("requests with a wrong outcome")
    if sum(results["outcomes"].values()) != results["requests"]:
        found.append("requests without an outcome")
    # The slope of a few requests says nothing.
    if results["requests"] >= 5000 and results["memory_slope_mb_per_1000"] >= MAX_SLOPE:
        found.append("memory grows")
    if results["exit_code"] != 0:
        found.append(f"the server ended with {results['exit_code']}")
    return found


if __name__ == "__main__":
    main()
