"""Measure the server under load: `python -m benchmarks.load --output benchmarks/results`.

Clients run in processes of their own, over both transports, against 127.0.0.1. Four measurements:

overhead   one request after the other: the server's answer against the same detector in-process
closed     as many requests at a time as there are connections: throughput and latency
open       requests at a fixed average rate, up to twice what the server sustains, with a deadline
batching   8 requests at a time of a small cloud through the real network, with and without batches

The dummy network sleeps for a known time, so what is left is the server's own.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.apart import Apart
from benchmarks.in_process import OPTIONS, POINTS, InProcess
from benchmarks.load_client import Sample, Task
from benchmarks.load_picture import draw
from benchmarks.served import Served, served

ROOT = Path(__file__).parents[1]
TRANSPORTS = ("grpc", "rest")
SMALL = 3_000
SMALL_OPTIONS = {"num_approach_points": 8, "num_candidates": 100}
DUMMY_SECONDS = 0.02
# Of requests in the open loop, seconds: too short for a queue that is full.
DEADLINE = 0.5
NETWORK_DEADLINE = 5.0
BLOCK = 20  # pairs
OVERLOAD = 2.0  # times the sustainable rate
START_SECONDS = 1.0  # from the order to the first request


def main() -> None:
    """Measure and write load.json and load.png."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    parser.add_argument("--pairs", type=int, default=200, help="requests that overhead compares")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS,
        help="measure these, each at most three minutes, and keep the rest of load.json",
    )  # fmt: skip
    given = parser.parse_args()
    kept = given.output / "load.json"
    results: dict[str, Any] = {}
    if tuple(given.only) != PARTS and kept.exists():
        results = json.loads(kept.read_text())
    results["machine"] = machine()
    for part in PARTS:
        if part in given.only:
            results[part] = MEASURED[part](results, given)
    results["targets"] = targets(results)
    given.output.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(results, indent=1) + "\n")
    if not PICTURED - results.keys():
        draw(results, given.output / "load.png")
    print(json.dumps(results["targets"], indent=1))


def machine() -> dict[str, Any]:
    """Where it was measured."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "load_average": os.getloadavg()[0],  # other work on the machine makes everything slower
    }


def overhead(results: dict[str, Any], given: argparse.Namespace) -> dict[str, Any]:
    """What an answer takes beyond the detector, by the detector and the transport."""
    found = {}
    for seconds in (0.0, DUMMY_SECONDS):
        with served("--backend", "dummy", "--dummy-seconds", str(seconds)) as dummy:
            milliseconds = f"{1000 * seconds:g}"
            found[f"dummy of {milliseconds} ms"] = beyond(dummy, milliseconds, given.pairs)
    with served(threads=1) as real:
        found["network"] = beyond(real, "network", given.pairs // 2)
    return found


def beyond(server: Served, kind: str, pairs: int) -> dict[str, Any]:
    """Milliseconds that an answer over a transport takes beyond the detector.

    That is called here, where it finds its code and data still in the processor's cache, and in a
    process of its own, which has idled as long as the server; the client has one of its own too.
    They take turns, so that what else the machine does is in all of them.
    """
    found: dict[str, Any] = {}
    here = InProcess(kind)
    with Apart("benchmarks.in_process", kind) as apart:
        for transport in TRANSPORTS:
            alone: list[float] = []
            alone_cpu: list[float] = []
            idled: list[float] = []
            answers: list[float] = []
            with Apart("benchmarks.one_client", transport, server.address(transport)) as client:
                for _ in range(5):
                    client.seconds()
                    here.seconds()
                    apart.seconds()
                served_cpu = server.cpu_seconds()
                for _ in range(pairs):
                    for times, value in zip((alone, alone_cpu), here.seconds(), strict=True):
                        times.append(value)
                    answers.append(client.seconds()[0])
                    idled.append(apart.seconds()[0])
            served_cpu = (server.cpu_seconds() - served_cpu) / pairs
            found[transport] = {
                "pairs": pairs,
                "load_average": os.getloadavg()[0],
                "in_process_ms": percentiles(alone),
                "in_idle_process_ms": percentiles(idled),
                "served_ms": percentiles(answers),
                "overhead_p50_ms": 1000 * float(np.median(answers) - np.median(alone)),
                "overhead_p50_of_pairs_ms": 1000 * float(np.median(np.subtract(answers, alone))),
                "overhead_p50_of_idle_ms": 1000 * float(np.median(answers) - np.median(idled)),
                "overhead_p50_quietest_blocks_ms": quietest_blocks(alone, answers),
                "overhead_of_processors_ms": 1000 * (served_cpu - float(np.mean(alone_cpu))),
            }
            print(json.dumps({"overhead": kind, "transport": transport} | found[transport]))
    return found


def quietest_blocks(alone: Sequence[float], answers: Sequence[float]) -> float | None:
    """The fastest block's p50 of the answers, less that of the detector; ms; None of fewer pairs.

    A block is BLOCK pairs in a row. Other work on the machine comes in bursts, and every thread
    that it keeps waiting adds to what an answer takes.
    """
    starts = range(0, len(answers) - BLOCK + 1, BLOCK)
    if not starts:
        return None
    fastest = [
        min(float(np.median(times[start : start + BLOCK])) for start in starts)
        for times in (answers, alone)
    ]
    return 1000 * (fastest[0] - fastest[1])


def closed(results: dict[str, Any], given: argparse.Namespace) -> list[dict[str, Any]]:
    """Throughput and latency by the number of requests at a time."""
    rows = []
    with served("--backend", "dummy", "--dummy-seconds", str(DUMMY_SECONDS)) as server:
        for transport in TRANSPORTS:
            address = server.address(transport)
            task = Task(transport, address, POINTS, OPTIONS, given.seconds, seed=0)
            for concurrency in (1, 2, 4, 8):
                rows.append({"concurrency": concurrency} | measure(server, task, concurrency))
    return rows


def open_loops(results: dict[str, Any], given: argparse.Namespace) -> list[dict[str, Any]]:
    """What becomes of requests that come at fractions and multiples of what is sustained."""
    rows = []
    for transport in TRANSPORTS:
        of_transport = [row for row in results["closed"] if row["transport"] == transport]
        sustainable = max(row["accepted_per_second"] for row in of_transport)
        for share in (0.25, 0.5, 0.75, 0.9, 1.5, OVERLOAD):
            with served("--backend", "dummy", "--dummy-seconds", str(DUMMY_SECONDS)) as server:
                task = Task(
                    transport, server.address(transport), POINTS, OPTIONS, given.seconds, seed=0,
                    rate=share * sustainable, timeout=DEADLINE,
                )  # fmt: skip
                rows.append({"share": share} | measure(server, task, concurrency=96))
    return rows


def network(results: dict[str, Any], given: argparse.Namespace) -> list[dict[str, Any]]:
    """The real network over gRPC: one and two at a time, then half and twice what that sustains."""
    with served(threads=1) as server:
        task = Task("grpc", server.address("grpc"), POINTS, OPTIONS, 2 * given.seconds, seed=0)
        rows = [{"concurrency": number} | measure(server, task, number) for number in (1, 2)]
        sustainable = max(row["accepted_per_second"] for row in rows)
        for share in (0.5, OVERLOAD):
            timed = replace(task, rate=share * sustainable, timeout=NETWORK_DEADLINE)
            rows.append({"share": share} | measure(server, timed, concurrency=96))
    return rows


def batching(results: dict[str, Any], given: argparse.Namespace) -> dict[str, Any]:
    """Throughput of 8 small clouds at a time with the real network, batches on and off in turns."""
    found: dict[str, list[float]] = {"on": [], "off": []}
    with ExitStack() as stack:
        on = ("--batching", "--max-batch-wait-microseconds", "5000")
        servers = {
            "off": stack.enter_context(served(threads=1)),
            "on": stack.enter_context(served(*on, threads=1)),
        }
        for _ in range(3):
            for name, server in servers.items():
                address = server.address("grpc")
                task = Task("grpc", address, SMALL, SMALL_OPTIONS, given.seconds, seed=0)
                row = measure(server, task, concurrency=8)
                found[name].append(row["accepted_per_second"])
    medians = {name: float(np.median(rates)) for name, rates in found.items()}
    return {
        "points": SMALL,
        **SMALL_OPTIONS,
        "concurrency": 8,
        "requests_per_second": found,
        "ratio": medians["on"] / medians["off"],
    }


def measure(server: Served, task: Task, concurrency: int) -> dict[str, Any]:
    """Run two client processes with half of the load each (one, for one connection)."""
    processes = min(2, concurrency)
    before, cpu = server.memory(), server.cpu_seconds()
    samples: list[Sample] = []
    clients = [
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.load_client"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(processes)
    ]
    for client in clients:
        assert client.stdout is not None
        client.stdout.readline()
    start = time.monotonic() + START_SECONDS
    for number, client in enumerate(clients):
        share = replace(
            task,
            start=start,
            seed=number,
            concurrency=concurrency // processes,
            rate=None if task.rate is None else task.rate / processes,
        )
        assert client.stdin is not None
        client.stdin.write(share.text())
        client.stdin.flush()
    for client in clients:
        output, _ = client.communicate(timeout=task.seconds + 120)
        samples += [tuple(sample) for sample in json.loads(output)]
    row = summary(samples, start, task.seconds)
    row |= {"transport": task.transport, "points": task.points, "rate": task.rate}
    row |= {
        "memory_before_mb": before,
        "memory_after_mb": server.memory(),
        "memory_peak_mb": server.peak_memory(),
        "server_cpu_ms_per_request": 1000 * (server.cpu_seconds() - cpu) / max(1, len(samples)),
    }
    print(json.dumps(row), flush=True)
    return row


def summary(samples: Sequence[Sample], start: float, seconds: float) -> dict[str, Any]:
    """Latencies of what was accepted and refused, and how many there were."""
    codes = [code for _, _, code in samples]
    took = {code: [s for _, s, other in samples if other == code] for code in set(codes)}
    accepted = took.get("OK", [])
    end = max((due + s for due, s, code in samples if code == "OK"), default=start)
    return {
        "requests": len(samples),
        "codes": {code: len(times) for code, times in sorted(took.items())},
        "accepted_per_second": len(accepted) / max(seconds, end - start),
        "accepted_ms": percentiles(accepted),
        "refused_ms": percentiles(took.get("RESOURCE_EXHAUSTED", [])),
    }


def percentiles(seconds: Sequence[float]) -> dict[str, float] | None:
    """In milliseconds; None of nothing."""
    if not seconds:
        return None
    values = np.percentile(np.array(seconds) * 1000, (50, 90, 95, 99, 100)).round(3)
    return dict(zip(("p50", "p90", "p95", "p99", "max"), values.tolist(), strict=True))


def targets(results: dict[str, Any]) -> dict[str, Any]:
    """The figures that the project asks of itself, beside what was measured."""
    found: dict[str, Any] = {}
    for name, limit in (("grpc", 3.0), ("rest", 6.0)):
        for kind, both in results.get("overhead", {}).items():
            of = ("overhead_p50_ms", "overhead_p50_of_pairs_ms", "overhead_p50_of_idle_ms",
                  "overhead_p50_quietest_blocks_ms", "overhead_of_processors_ms",
                  "load_average")  # fmt: skip
            key = f"{name}: overhead p50 with the {kind}, ms (<= {limit:g})"
            found[key] = {figure: both[name].get(figure) for figure in of}
    dummy = [(f"{row['transport']}, dummy", DEADLINE, row) for row in results.get("open", [])]
    real = [("grpc, network", NETWORK_DEADLINE, row) for row in results.get("network", [])]
    for kind, deadline, row in dummy + real:
        if row.get("share") != OVERLOAD:
            continue
        name = f"{kind}: at {OVERLOAD:g} times the sustainable rate"
        found[f"{name}, p99 of accepted, ms (<= {1000 * deadline:g})"] = row["accepted_ms"]["p99"]
        found[f"{name}, refused, ms (<= 50)"] = row["refused_ms"]
        found[f"{name}, codes"] = row["codes"]
    if "batching" in results:
        found["batching: throughput of 8 small clouds, ratio (>= 1.3, or off by default)"] = round(
            results["batching"]["ratio"], 2
        )
    return found


# In order: the open loop takes its rates from the closed one.
MEASURED: dict[str, Callable[[dict[str, Any], argparse.Namespace], Any]] = {
    "overhead": overhead,
    "closed": closed,
    "open": open_loops,
    "network": network,
    "batching": batching,
}
PARTS = tuple(MEASURED)
PICTURED = {"overhead", "closed", "open"}


if __name__ == "__main__":
    main()
