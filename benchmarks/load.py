"""Measure servers under load: `python -m benchmarks.load` writes load.json.

Clients in processes of their own send clouds of 20,000 points, each its next request once it has an
answer: latency and throughput by the number of clients. Without `--server` one is started, and
measured over both transports. Several servers take turns, so that other work on the machine meets
all alike: a new design beside the old one.
"""

import argparse
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.measuring import RESULTS, machine, served, write_results

from edgegrasp_camera.arrays import Float32
from edgegrasp_client import DetectOptions, GraspClient, GraspClientError

POINTS = 20_000
OPTIONS: DetectOptions = {"num_approach_points": 32, "num_candidates": 500}
PROCESSES = 2  # that the clients are shared among
TIMEOUT = 120.0  # seconds until a request is given up
START_SECONDS = 1.0  # from the order to the first request: clouds are made
OK = "OK"


@dataclass(frozen=True)
class Task:
    """The share of one process."""

    address: str  # of the server
    clients: int  # requests at a time
    start: float  # moment of `time.monotonic` of the first request
    seconds: float  # how long requests are sent
    seed: int = 0  # of the cloud


@dataclass(frozen=True)
class Sample:
    """The outcome of one request."""

    seconds: float  # until its answer or error
    detector_seconds: float | None  # of the detection, as the answer says; None without an answer
    code: str  # OK, or the name of the client's error


def main() -> None:
    """Measure and write load.json."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--server", action="append", help="host:port or http://host:port")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 2, 8])
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each server")
    given = parser.parse_args()
    results: dict[str, Any] = {"machine": machine(), "points": POINTS, **OPTIONS}
    with ExitStack() as stack:
        servers = {address: address for address in given.server or ()}
        if not servers:
            own = stack.enter_context(served())
            servers = {"grpc": own.grpc_address, "rest": own.http_url}
        pool = stack.enter_context(ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")))
        list(pool.map(time.sleep, [START_SECONDS] * PROCESSES))  # until all processes have started
        results["servers"] = closed_loops(pool, servers, given)
    write_results(given.output, "load", results)


def closed_loops(
    pool: ProcessPoolExecutor, servers: dict[str, str], given: argparse.Namespace
) -> list[dict[str, Any]]:
    """A row for each server and number of clients, over all rounds."""
    samples: dict[tuple[int, str], list[list[Sample]]] = {}
    for _ in range(given.rounds):
        for clients in given.clients:
            for name, address in servers.items():
                task = Task(address, clients, 0.0, given.seconds)
                samples.setdefault((clients, name), []).append(send(pool, task))
    rows = []
    for (clients, name), runs in samples.items():
        rates = [sum(one.code == OK for one in run) / given.seconds for run in runs]
        row = {"server": name, "clients": clients, "per_second": statistics.median(rates)}
        rows.append(row | summary([one for run in runs for one in run]))
        print(rows[-1], flush=True)
    return rows


def send(pool: ProcessPoolExecutor, task: Task) -> list[Sample]:
    """Share a task among the processes, as many as it has clients at most."""
    processes = min(PROCESSES, task.clients)
    start = time.monotonic() + START_SECONDS
    share = replace(task, clients=task.clients // processes, start=start)
    shares = [replace(share, seed=number) for number in range(processes)]
    return [sample for samples in pool.map(run_clients, shares) for sample in samples]


def run_clients(task: Task) -> list[Sample]:
    """Send until the time is over; every request that was sent has its sample."""
    points = cloud(POINTS, task.seed)

    def work() -> list[Sample]:
        samples = []
        with GraspClient(task.address, timeout=TIMEOUT, retry=False) as client:
            time.sleep(max(0.0, task.start - time.monotonic()))
            while time.monotonic() < task.start + task.seconds:
                samples.append(request(client, points))
        return samples

    with ThreadPoolExecutor(task.clients) as threads:
        work_of_each = [threads.submit(work) for _ in range(task.clients)]
        return [sample for one in work_of_each for sample in one.result()]


def request(client: GraspClient, points: Float32) -> Sample:
    """Send one request."""
    begun = time.monotonic()
    try:
        answer = client.detect(points, **OPTIONS)
    except GraspClientError as error:
        return Sample(time.monotonic() - begun, None, type(error).__name__)
    return Sample(time.monotonic() - begun, answer.seconds["total"], OK)


def summary(samples: Sequence[Sample]) -> dict[str, Any]:
    """Counts of outcomes, and times in milliseconds."""
    answered = [one for one in samples if one.code == OK]
    beyond = [one.seconds - one.detector_seconds for one in answered if one.detector_seconds]
    return {
        "codes": dict(Counter(one.code for one in samples)),
        "answered_ms": percentiles([one.seconds for one in answered]),
        "beyond_the_detector_ms": percentiles(beyond),
    }


def percentiles(seconds: Sequence[float]) -> dict[str, float] | None:
    """In milliseconds; None without any."""
    if not seconds:
        return None
    values = np.percentile(np.array(seconds) * 1000, (50, 90, 99, 100)).round(3)
    return dict(zip(("p50", "p90", "p99", "max"), values.tolist(), strict=True))


def cloud(points: int, seed: int) -> Float32:
    """(N, 3) metres: a table of 0.3 m with five boxes on it, seen from all sides."""
    random = np.random.default_rng([seed, points])
    parts = [random.uniform((0.0, 0.0, 0.0), (0.3, 0.3, 0.001), (points // 3, 3))]
    for count in np.diff(np.linspace(points // 3, points, 6).astype(int)):
        corner = random.uniform((0.02, 0.02, 0.001), (0.22, 0.22, 0.001))
        inside = random.uniform(0.0, 1.0, (count, 3))
        inside[np.arange(count), random.integers(0, 3, count)] = random.integers(0, 2, count)
        parts.append(corner + inside * random.uniform(0.02, 0.06, 3))
    return np.concatenate(parts).astype(np.float32)


if __name__ == "__main__":
    main()
