"""One client process of benchmarks/load.py: told what to send on stdin, writes samples to stdout.

A sample is [moment due, seconds until the answer, code]. In an open loop requests are due at
fixed moments whatever became of those before, and their seconds count from then, so that a server
that stalls cannot hide it by slowing its clients down.
"""

import json
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import numpy as np
from benchmarks.senders import cloud, sender, wait_until

Sample = tuple[float, float, str]


@dataclass(frozen=True)
class Task:
    """What one process sends."""

    transport: str
    address: str
    points: int
    options: dict[str, int]
    seconds: float
    seed: int
    start: float = 0.0  # moment of time.monotonic
    concurrency: int = 1  # connections
    rate: float | None = None  # requests a second on average, an open loop; None: a closed loop
    timeout: float | None = None  # deadline of each request

    def text(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self)) + "\n"


def run(task: Task) -> list[Sample]:
    """Send until the time is over; every request that was sent has its sample."""
    points = cloud(task.points, task.seed)
    samples: list[Sample] = []
    due = _schedule(task)
    lock = threading.Lock()

    def work() -> None:
        with sender(task.transport, task.address, points, task.options) as one:
            wait_until(task.start)
            while True:
                with lock:
                    moment = next(due, None)
                if moment is None:
                    return
                wait_until(moment)
                told = one.send(task.timeout)
                samples.append((moment, time.monotonic() - moment, told.code))

    with ThreadPoolExecutor(task.concurrency) as pool:
        for future in [pool.submit(work) for _ in range(task.concurrency)]:
            future.result()
    return samples


def _schedule(task: Task) -> Iterator[float]:
    """Moments at which requests are due."""
    end = task.start + task.seconds
    if task.rate is None:
        while (now := time.monotonic()) < end:
            yield max(now, task.start)
        return
    random = np.random.default_rng([task.seed, 1])
    moment = task.start
    while (moment := moment + random.exponential(1.0 / task.rate)) < end:
        yield moment


if __name__ == "__main__":
    print("ready", flush=True)  # imported; the start is not before that
    print(json.dumps(run(Task(**json.loads(sys.stdin.readline())))), flush=True)
