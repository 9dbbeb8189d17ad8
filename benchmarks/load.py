"""Measure servers under load: `python -m benchmarks.load` writes load.json.

Clients in threads send clouds or depth images; each sends its next request after an answer. This
measures latency and throughput by the number of clients. Without `--server` a server is started,
and measured over both transports. Several servers, such as a new and an old design, take turns, so
that other work on the machine affects all alike.
"""

import argparse
import itertools
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.measuring import RESULTS, machine, write_results
from PIL import Image

import edgegrasp_service
from edgegrasp_camera.arrays import Float32
from edgegrasp_client import DetectOptions, GraspClient, GraspClientError
from edgegrasp_client.connection import local_server

POINTS = 20_000
SAMPLE = Path(edgegrasp_service.__file__).parent / "playground" / "samples" / "seven_depth.png"
FOCAL = 540.0  # pixels, of the sample's camera
OPTIONS: DetectOptions = {"num_approach_points": 32, "num_candidates": 500}
TIMEOUT = 120.0  # seconds until a client gives up
OK = "OK"


class Sample(NamedTuple):
    """The outcome of one request."""

    seconds: float  # until its answer or error
    beyond: float  # the part of these outside the detector; NaN without an answer
    code: str  # OK, or the name of the client's error


def main() -> None:
    """Measure and write load.json."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--server", action="append", help="host:port or http://host:port")
    parser.add_argument("--points", type=int, default=POINTS, help="of a cloud; 0: a depth image")
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 2, 8])
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each server")
    given = parser.parse_args()
    results: dict[str, Any] = {"machine": machine(), "points": given.points, **OPTIONS}
    results["servers"] = []
    with ExitStack() as stack:
        servers = {address: address for address in given.server or ()}
        if not servers:
            own = stack.enter_context(local_server())
            servers = {"grpc": own.grpc_address, "rest": own.http_url}
        runs: dict[tuple[int, str], list[list[Sample]]] = {}
        rates: dict[tuple[int, str], list[float]] = {}
        for turn, clients, name in itertools.product(range(given.rounds), given.clients, servers):
            begun = time.monotonic()
            samples = run_clients(servers[name], clients, given.seconds, given.points, seed=turn)
            answers = sum(one.code == OK for one in samples)
            rates.setdefault((clients, name), []).append(answers / (time.monotonic() - begun))
            runs.setdefault((clients, name), []).append(samples)
    for (clients, name), found in runs.items():
        samples = list(itertools.chain(*found))
        answered = [one for one in samples if one.code == OK]
        row = {
            "server": name,
            "clients": clients,
            "per_second": statistics.median(rates[clients, name]),
            "codes": dict(Counter(one.code for one in samples)),
            "answered_ms": percentiles([one.seconds for one in answered]),
            "beyond_the_detector_ms": percentiles([one.beyond for one in answered]),
        }
        results["servers"].append(row)
        print(row, flush=True)
    write_results(given.output, "load", results)


def run_clients(address: str, clients: int, seconds: float, points: int, seed: int) -> list[Sample]:
    """Send requests until the time is over; returns a sample for each request sent."""
    request: dict[str, Any] = {"cloud": cloud(points, seed)}
    if not points:
        depth = np.asarray(Image.open(SAMPLE))
        request = {"depth_images": [{"depth": depth, "intrinsics": (FOCAL, FOCAL, 320.0, 240.0)}]}
    end = time.monotonic() + seconds

    def work(_: int) -> list[Sample]:
        samples = []
        with GraspClient(address, timeout=TIMEOUT, retry=False) as client:
            while (begun := time.monotonic()) < end:
                try:
                    code, detector = OK, client.detect(**request, **OPTIONS).seconds["total"]
                except GraspClientError as error:
                    code, detector = type(error).__name__, np.nan
                took = time.monotonic() - begun
                samples.append(Sample(took, took - detector, code))
        return samples

    with ThreadPoolExecutor(clients) as threads:
        return [sample for samples in threads.map(work, range(clients)) for sample in samples]


def percentiles(seconds: Sequence[float]) -> dict[str, float] | None:
    """Percentiles in milliseconds; None without samples."""
    if not seconds:
        return None
    values = np.percentile(np.array(seconds) * 1000, (50, 90, 99, 100)).round(3)
    return dict(zip(("p50", "p90", "p99", "max"), values.tolist(), strict=True))


def cloud(points: int, seed: int) -> Float32:
    """(N, 3) metres: a table of 0.3 m with five boxes on it, observed from all sides."""
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
