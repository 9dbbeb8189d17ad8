"""Send requests to a server under attack for minutes: `python -m benchmarks.soak --minutes 10`.

Clients send clouds of 32 to 20,000 points to a dummy network, over unary gRPC, streams and REST, a
few of them malformed and a few abandoned; each answer contains the CRC-32 of the cloud that the
server received. Two attackers with another address run at the same time: one sends requests made to
kill workers, one holds connections and streams open without reading or sending anything. A separate
process checks the server's health, each time on a new connection. Fails unless every request has
its own expected outcome, health is never refused, each attack is answered with an error, memory
does not grow and the server stops.
"""

import asyncio
import base64
import contextlib
import io
import itertools
import json
import multiprocessing
import os
import socket
import struct
import sys
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import httpx
import numpy as np
import psutil
import typer
from benchmarks import serve_dummy
from benchmarks.measuring import RESULTS, memory, write_results

from edgegrasp_camera.arrays import Float32
from edgegrasp_client import AsyncGraspClient, Detection, GraspClient, StreamRequest, errors
from edgegrasp_client.connection import Addresses, local_server

ANSWERED = "answered"
REFUSED = "refused"
CANCELLED = "cancelled"
EXPECTED = {"good": {ANSWERED}, "malformed": {REFUSED}, "cancelled": {CANCELLED, ANSWERED}}
FAULTS: tuple[dict[str, Any], ...] = ({"seed": -1}, {"model": "none"}, {"viewpoint": [1e300, 0, 0]})
SECONDS = 30.0  # timeout of a request
START_SECONDS = 1.0  # for processes to start
STOP_SECONDS = 30.0  # for the server to stop
PROBE_SECONDS = 0.1  # between two health checks
HEALTH_TIMEOUT = 5.0 * float(os.environ.get("SOAK_PATIENCE", "1"))  # as in docker/kubernetes
MEMORY_SAMPLES = 60
MAX_GROWTH = 0.05  # of memory, from the third quarter of the attacks to the last
ATTACKER = "127.0.0.2"  # fairness is between addresses
HELD_SECONDS = 8.0  # for which the second attacker holds its connections
PAGES, CHECKS, STREAMS = 540, 200, 16  # numbers of these that it opens
CALLS_PER_CONNECTION = 90  # fewer than the server allows
CHECK, STREAM = "/grpc.health.v1.Health/Check", "/edgegrasp.v1.GraspService/DetectGraspsStream"
# Room for all clients. Thousands of refusals would each be a line in the log.
FLAGS = ("--max-queue-length", "512", "--max-streams", "64", "--log-level", "error")


def main(
    output: Path = RESULTS,
    minutes: float = 10.0,
    clients: Annotated[int, typer.Option(help="At a time, over all three ways.")] = 32,
    seed: int = 0,
) -> None:
    """Run the clients and the attacks, write soak.json, and exit with 1 if anything is wrong."""
    os.environ["DUMMY_SECONDS"] = "0.002"
    with local_server(*FLAGS, program=[sys.executable, "-P", serve_dummy.__file__]) as server:
        results = run(server, clients, minutes * 60, seed)
        process = psutil.Process(server.pid)
        process.terminate()
        results["exit_code"] = int(process.wait(STOP_SECONDS))
    # In a shorter time, memory may still grow because the attacks have just begun.
    results["faults"] = faults(results, grows=minutes >= 2)
    write_results(output, "soak", results)
    print(json.dumps(results, indent=1))
    sys.exit(1 if results["faults"] else 0)


def run(server: Addresses, clients: int, seconds: float, seed: int) -> dict[str, Any]:
    """Run clients, attacks and the probe in separate processes; returns the figures."""
    context, works = multiprocessing.get_context("spawn"), (probe, poison, hold_connections)
    with context.Manager() as manager, ProcessPoolExecutor(len(works), context) as pool:
        stop = manager.Event()
        list(pool.map(time.sleep, [START_SECONDS] * len(works)))  # until all have started
        where = server.http_url, server.grpc_address, stop
        beside = [pool.submit(work, *where) for work in works]
        figures = asyncio.run(run_clients(server, clients, seconds, seed))
        stop.set()
        refused, *attacks = (work.result() for work in beside)
    return figures | {"health_refused": refused, "attacks": attacks}


# The clients


@dataclass(frozen=True)
class Plan:
    """One request."""

    number: int
    kind: str  # good, malformed or cancelled
    size: int  # points
    wait: float  # seconds until its client leaves
    seed: int

    def points(self) -> Float32:
        """The cloud (N, 3) of this plan, different from those of all other plans."""
        random = np.random.default_rng([self.seed, self.number])
        return random.uniform(-0.2, 0.2, (self.size, 3)).astype(np.float32)

    def options(self) -> Any:
        """The options of the request; invalid for a malformed request."""
        return FAULTS[self.number % len(FAULTS)] if self.kind == "malformed" else {}


def plans(seed: int, end: float) -> Iterator[Plan]:
    """Random requests until `end`: 90 % valid, 5 % malformed, 5 % cancelled by the client."""
    random = np.random.default_rng(seed)
    for number in itertools.count():
        if time.monotonic() > end:
            return
        kind = random.choice(["good", "malformed", "cancelled"], p=[0.9, 0.05, 0.05])
        size = int(np.exp(random.uniform(np.log(32), np.log(20_000))))
        yield Plan(number, str(kind), size, float(random.uniform(0.0, 0.01)), seed)


async def run_clients(server: Addresses, clients: int, seconds: float, seed: int) -> dict[str, Any]:
    """Send plans for `seconds` from several clients at a time; returns the figures."""
    todo = plans(seed, time.monotonic() + seconds)
    outcomes, wrong, memory_mb = Counter[str](), list[dict[str, Any]](), list[float]()

    async def send(way: str) -> None:
        """Send plans one by one."""
        address = server.http_url if way == "rest" else server.grpc_address
        async with AsyncGraspClient(address, timeout=SECONDS, retry=False) as client:
            for plan in todo:
                came = await outcome(client, way, plan)
                outcomes[f"{way} {plan.kind}: {came}"] += 1
                if came not in EXPECTED[plan.kind]:
                    wrong.append({**asdict(plan), "transport": way, "outcome": came})

    async def sample() -> None:
        while True:
            memory_mb.append(round(await asyncio.to_thread(memory, server.pid), 1))
            await asyncio.sleep(seconds / MEMORY_SAMPLES)

    sampling = asyncio.create_task(sample())
    ways = itertools.cycle(("grpc", "stream", "rest"))
    await asyncio.gather(*map(send, itertools.islice(ways, clients)))
    sampling.cancel()
    return {
        "requests": outcomes.total(),
        "wrong": wrong[:20],
        "outcomes": dict(sorted(outcomes.items())),
        "memory_mb": memory_mb,
    }


async def outcome(client: AsyncGraspClient, way: str, plan: Plan) -> str:
    """The outcome of a plan."""
    try:
        async with asyncio.timeout(plan.wait if plan.kind == "cancelled" else None):
            answer = await ask(client, way, plan)
        mine = answer.counts["crc32"] == zlib.crc32(plan.points().tobytes())
        return ANSWERED if mine else "another cloud's answer"
    except TimeoutError:
        return CANCELLED
    except errors.InvalidRequestError:
        return REFUSED
    except errors.GraspClientError as error:
        return type(error).__name__


async def ask(client: AsyncGraspClient, way: str, plan: Plan) -> Detection:
    """Send one plan, alone or in its own stream; raises the error if it is answered with one."""
    if way != "stream":
        return await client.detect(plan.points(), **plan.options())
    stream = client.detect_stream([StreamRequest(plan.points(), **plan.options())])
    async with contextlib.aclosing(stream) as answers:
        return (await anext(answers)).result()


# The attackers and the probe


def poison(url: str, address: str, stop: Any) -> dict[str, int]:
    """Send small requests that once killed workers; returns the number of each status."""
    came: Counter[str] = Counter()
    transport = httpx.HTTPTransport(local_address=ATTACKER)
    with httpx.Client(base_url=url, transport=transport, timeout=SECONDS) as http:
        for number in itertools.takewhile(lambda _: not stop.is_set(), itertools.count()):
            for media, body in poisons(number).items():
                headers = {"content-type": f"application/{media}"}
                try:
                    answer = http.post("/v1/grasps", content=body, headers=headers)
                    came[f"{media}: {answer.status_code}"] += 1
                except httpx.HTTPError as error:
                    came[f"{media}: {type(error).__name__}"] += 1
    return dict(came)


def poisons(number: int) -> dict[str, bytes]:
    """Bodies by media type: an offset beyond the data, a 4 GiB LZMA dictionary, a text header."""
    fields = [
        {"name": name, "offset": offset, "datatype": 7, "count": 1}
        for name, offset in (("x", 2**31 - 4), ("y", 4), ("z", 8))
    ]
    cloud = {"height": 1, "width": 1, "fields": fields, "point_step": 12, "row_step": 12}
    cloud["data"] = base64.b64encode(bytes(12)).decode()
    header = b"-" * 9900 + b"1"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("points.npy", b"x" * 100 + str(number).encode())
    return {
        "json": json.dumps({"point_cloud2": cloud, "options": {"seed": number}}).encode(),
        "x-npy": b"\x93NUMPY\x02\x00" + struct.pack("<I", len(header)) + header,
        "x-npz": file.getvalue().replace(struct.pack("<I", 2**23), b"\xff" * 4, 1),
    }


def hold_connections(url: str, address: str, stop: Any) -> dict[str, int]:
    """Open pages without reading them and gRPC calls without sending; hold and reopen them."""
    came: Counter[str] = Counter()
    page = b"GET /docs/assets/swagger-ui-bundle.js HTTP/1.1\r\nHost: x\r\n\r\n"
    while not stop.is_set():
        with contextlib.ExitStack() as stack:
            for _ in range(PAGES):
                with contextlib.suppress(OSError):
                    came["pages"] += bool(stack.enter_context(connect(url)).send(page))
            calls = [CHECK] * CHECKS + [STREAM] * STREAMS
            for first in range(0, len(calls), CALLS_PER_CONNECTION):
                with contextlib.suppress(OSError):
                    connection = stack.enter_context(connect(address))
                    connection.sendall(http2_opening())
                    for number, path in enumerate(calls[first : first + CALLS_PER_CONNECTION]):
                        connection.sendall(http2_headers(path, 2 * number + 1))
                        came["silent calls"] += 1
            stop.wait(HELD_SECONDS)
    return dict(came)


def connect(address: str) -> socket.socket:
    """An attacker's connection, with a small buffer."""
    host, _, port = address.removeprefix("http://").rpartition(":")
    made = socket.create_connection((host, int(port)), SECONDS, (ATTACKER, 0))
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return made


def http2_frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    """One frame of HTTP/2."""
    return struct.pack(">IBBI", len(payload), kind, flags, stream)[1:] + payload


def http2_opening() -> bytes:
    """The connection preface and an empty SETTINGS frame."""
    return b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + http2_frame(4, 0, 0, b"")


def http2_headers(path: str, stream: int) -> bytes:
    """The HEADERS frame of a gRPC call that never ends."""
    headers = b"\x83\x86"  # :method POST, :scheme http
    fields = {":path": path, ":authority": "x", "content-type": "application/grpc"}
    for text in itertools.chain.from_iterable((fields | {"te": "trailers"}).items()):
        mark = b"\x00" if text in (*fields, "te") else b""
        headers += mark + bytes([len(text)]) + text.encode()
    return http2_frame(1, 4, stream, headers)


def probe(url: str, address: str, stop: Any) -> dict[str, int]:
    """Ask for health over both transports, each time on a new connection; returns refusals."""
    refused: Counter[str] = Counter()
    while not stop.wait(PROBE_SECONDS):
        for where in (url, address):
            with GraspClient(where) as client:
                refused[where] += not client.ready(timeout=HEALTH_TIMEOUT)
    return dict(+refused)


def faults(results: dict[str, Any], grows: bool) -> list[str]:
    """The faults found, empty if none; `grows`: whether growth of memory is a fault."""
    poisoned, held = results["attacks"]
    *_, before, after = np.array_split(results["memory_mb"], 4)
    found = {
        "requests with a wrong outcome": results["wrong"],
        "health was refused": results["health_refused"],
        "a poison was not refused": not all(
            one.endswith((": 400", ": 413", ": 429")) for one in poisoned
        ),
        "nothing was held open": not {"pages", "silent calls"} <= held.keys(),
        "memory grows": grows and np.median(after) > np.median(before) * (1 + MAX_GROWTH),
        f"the server ended with {results['exit_code']}": results["exit_code"],
    }
    return [fault for fault, is_one in found.items() if is_one]


if __name__ == "__main__":
    typer.run(main)
