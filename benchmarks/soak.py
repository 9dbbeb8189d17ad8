"""Send a server many requests of every kind: `python -m benchmarks.soak --requests 10000`.

Clouds of 32 to 20,000 points go through a dummy network, over unary gRPC, streams and REST, a few
of them malformed and a few abandoned by their client. Each answer carries the CRC-32 of the cloud
that the server saw, so an answer that belongs to another request is noticed. At the end every
request must have come to something, the server's memory must not have grown, and it must stop.
"""

import argparse
import json
import queue
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.served import Served, served
from benchmarks.soak_clients import ANSWERED, CANCELLED, REFUSED, STUCK, Plan, clients
from benchmarks.soak_picture import draw

ROOT = Path(__file__).parents[1]
EXPECTED = {"good": {ANSWERED}, "malformed": {REFUSED}, "cancelled": {CANCELLED, ANSWERED}}
SAMPLES = 100  # of memory
WARM_UP = 0.2  # of the requests: memory grows while pools and caches fill
MAX_SLOPE = 1.0  # MB per 1,000 requests


def main() -> None:
    """Send, write soak.json and soak.png, and fail where anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with served("--backend", "dummy", "--dummy-seconds", "0.002") as server:
        results = soak(server, plans(given.requests, given.seed), given.requests)
        begun = time.monotonic()
        results["exit_code"] = server.stop()
        results["stop_seconds"] = round(time.monotonic() - begun, 2)
    results["faults"] = faults(results)
    given.output.mkdir(parents=True, exist_ok=True)
    (given.output / "soak.json").write_text(json.dumps(results, indent=1) + "\n")
    draw(results, given.output / "soak.png")
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
    """Send what is to be sent, from several threads; every plan has an outcome."""
    outcomes: queue.Queue[tuple[Plan, str, str, float]] = queue.Queue()
    lock = threading.Lock()

    def next_plans(count: int) -> list[Plan]:
        with lock:
            return [plan for _, plan in zip(range(count), todo, strict=False)]

    threads = [
        threading.Thread(target=client.work, args=(next_plans, outcomes.put), daemon=True)
        for client in clients(server.http_url, server.grpc_address)
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
            wrong.append({"number": plan.number, "kind": plan.kind, "points": plan.size,
                          "transport": transport, "outcome": outcome})  # fmt: skip
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
        "memory_peak_mb": round(server.peak_memory(), 1),
        "server_threads": server.threads(),
        "server_files": settled_files(server),
    }


def slope(memory: list[tuple[int, float]], requests: int) -> float:
    """Least squares through the samples after the warm-up, MB per 1,000 requests."""
    after = np.array([sample for sample in memory if sample[0] > WARM_UP * requests])
    if len(after) < 2:
        return 0.0
    return round(float(np.polyfit(after[:, 0] / 1000, after[:, 1], 1)[0]), 4)


def settled_files(server: Served) -> int:
    """Open files once the connections of the clients are closed."""
    for _ in range(50):
        before = server.files()
        time.sleep(0.1)
        if server.files() == before:
            break
    return server.files()


def faults(results: dict[str, Any]) -> list[str]:
    """What is not as it should be."""
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


if __name__ == "__main__":
    main()
