"""Plan for more than a machine: `python -m benchmarks.queueing` writes queueing.json.

First come, first served, by as many workers as a machine has: times of service are those measured
with as many clients as workers, where nobody waits. What follows for more clients is compared with
what the load benchmark measures of them; then, for requests that come at random, how many a machine
may get for a bound on the wait, and how many machines a rate needs. docs/scaling.md has them.
"""

import argparse
import heapq
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.load import OK, OPTIONS, POINTS, PROCESSES, Task, percentiles, send
from benchmarks.measuring import RESULTS, machine, served, write_results

SIMULATED = 20_000  # requests
SHARES = (0.3, 0.5, 0.6, 0.7, 0.8, 0.9)  # of the most that a machine answers
RATES = (1, 100, 10_000)  # requests a second
MOST_P99 = 3.0  # times the time of service; a plan's bound
SPARE = 1  # machines more than needed: one may fail, or be exchanged


def main() -> None:
    """Measure, simulate, compare, plan."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.queueing")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each run")
    parser.add_argument("--rounds", type=int, default=6)
    given = parser.parse_args()
    runs = measure(given.workers, given.seconds, given.rounds)
    series = runs.pop(given.workers)
    capacity = given.workers / float(np.mean(np.concatenate(series)))
    results: dict[str, Any] = {"machine": machine(), "points": POINTS, **OPTIONS}
    results |= {"workers": given.workers, "most_per_second": capacity}
    results["service_ms"] = percentiles(np.concatenate(series).tolist())
    results["compared"] = [
        compared(clients, [one for run in measured for one in run], series, given.workers)
        for clients, measured in runs.items()
    ]
    results["at_random"] = [
        {"share": share, "per_second": share * capacity}
        | (percentiles(at_random(series, given.workers, share * capacity)) or {})
        for share in SHARES
    ]
    bound = MOST_P99 * results["service_ms"]["p50"]
    good = [row["per_second"] for row in results["at_random"] if row["p99"] <= bound]
    each = max(good, default=SHARES[0] * capacity)
    results["plan"] = [
        {"per_second": rate, "machines": math.ceil(rate / each) + SPARE} for rate in RATES
    ]
    for row in (*results["compared"], *results["at_random"], *results["plan"]):
        print(row)
    write_results(given.output, "queueing", results)


def measure(workers: int, seconds: float, rounds: int) -> dict[int, list[list[float]]]:
    """Seconds of answers, round by round; of clients as many as workers, twice, four times."""
    found: dict[int, list[list[float]]] = {}
    pool = ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn"))
    with pool, served("--workers", str(workers)) as server:
        send(pool, Task(server.grpc_address, workers, 0.0, 2.0))
        for _ in range(rounds):
            for clients in (workers, 2 * workers, 4 * workers):
                samples = send(pool, Task(server.grpc_address, clients, 0.0, seconds))
                answered = [one.seconds for one in samples if one.code == OK]
                found.setdefault(clients, []).append(answered)
    return found


def compared(
    clients: int, measured: Sequence[float], series: Sequence[Sequence[float]], workers: int
) -> dict[str, Any]:
    """What was measured of some clients, what the simulation says, and the second by the first."""
    ours, theirs = percentiles(closed(series, workers, clients)), percentiles(measured)
    assert ours is not None
    assert theirs is not None
    ratios = {name: round(ours[name] / theirs[name], 3) for name in ("p50", "p99")}
    return {"clients": clients, "measured_ms": theirs, "simulated_ms": ours, "ratio": ratios}


def closed(series: Sequence[Sequence[float]], workers: int, clients: int) -> list[float]:
    """Seconds of answers to clients that each send their next request once they have an answer."""
    draw, free, sent = service(series), [0.0] * workers, [0.0] * clients
    seconds = []
    for _ in range(SIMULATED):
        asked = heapq.heappop(sent)
        done = max(asked, heapq.heappop(free)) + next(draw)
        heapq.heappush(free, done)
        heapq.heappush(sent, done)
        seconds.append(done - asked)
    return seconds


def at_random(series: Sequence[Sequence[float]], workers: int, rate: float) -> list[float]:
    """Seconds of answers to requests that come independently of each other, `rate` a second."""
    arrivals = np.random.default_rng(1).exponential(1 / rate, SIMULATED).cumsum().tolist()
    draw, free = service(series), [0.0] * workers
    seconds = []
    for asked in arrivals:
        done = max(asked, heapq.heappop(free)) + next(draw)
        heapq.heappush(free, done)
        seconds.append(done - asked)
    return seconds


def service(series: Sequence[Sequence[float]]) -> Iterator[float]:
    """Times of service in the order they were measured, in stretches: slow ones come together."""
    random = np.random.default_rng(0)
    while True:
        run = series[int(random.integers(len(series)))]
        start = int(random.integers(len(run)))
        yield from run[start : start + 20]


if __name__ == "__main__":
    main()
