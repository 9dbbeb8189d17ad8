"""Count the files and functions of this project that one request to the server enters.

usage: scripts/trace_request.py

Asks a server of its own, of the default weights, for the grasps of a small cloud: as JSON over
HTTP, then over gRPC. Every process of the server counts, because each imports the `sitecustomize`
written here, which profiles all threads: the functions they enter while a flag file exists. The
second of two equal requests is counted, without what only the first one does.
"""

import json
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType

import httpx
import numpy as np

from edgegrasp_client import GraspClient
from edgegrasp_client.local_server import local_server

PACKAGES = ("edgegrasp_service", "edgegrasp_model")
SETTLE_SECONDS = 0.5  # until what follows an answer, such as its log line, is done


def profile_this_process(folder: Path) -> None:
    """Write each function of the project that is entered while `folder/flag` exists to `seen`."""
    flag, seen = folder / "flag", os.open(folder / "seen", os.O_APPEND | os.O_WRONLY)
    place: dict[CodeType, bytes] = {}

    def entered(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or (line := place.get(code)) == b"":
            return
        if line is None:
            place[code] = line = _line(code)
        if line and flag.exists():
            place[code] = b""
            os.write(seen, line)

    threading.setprofile(entered)
    sys.setprofile(entered)


def _line(code: CodeType) -> bytes:
    """Package, file and name of a function of the project; nothing for any other code."""
    path = Path(code.co_filename)
    package = next((name for name in PACKAGES if name in path.parts), None)
    # Comprehensions and generator expressions belong to the function they are in.
    if package is None or (code.co_name.startswith("<") and code.co_name != "<lambda>"):
        return b""
    file = "/".join(path.parts[len(path.parts) - path.parts[::-1].index(package) :])
    return f"{package}\t{file}\t{code.co_qualname}:{code.co_firstlineno}\n".encode()


@contextmanager
def traced_server() -> Iterator[tuple[str, str, Path]]:
    """A server whose processes are profiled: its URL, its gRPC address and the folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "seen").touch()
        scripts = str(Path(__file__).parent)
        (folder / "sitecustomize.py").write_text(
            f"import pathlib, sys; sys.path.append({scripts!r}); import trace_request\n"
            f"trace_request.profile_this_process(pathlib.Path({name!r}))\n"
        )
        paths = [name, *filter(None, [os.environ.get("PYTHONPATH")])]
        os.environ["PYTHONPATH"] = os.pathsep.join(paths)
        with local_server("--log-level", "info") as addresses:  # as it is by default
            yield *addresses, folder


def trace(transport: str, points: np.ndarray, options: dict[str, object]) -> None:
    """Send a request twice and print what the second one enters."""
    with traced_server() as (url, grpc_address, folder):
        for flag in (False, True):
            if flag:
                (folder / "flag").touch()
            if transport == "JSON":
                body = json.dumps({"points": points.tolist(), "options": options})
                header = {"content-type": "application/json"}
                httpx.post(f"{url}/v1/grasps", content=body, headers=header).raise_for_status()
            else:
                with GraspClient(grpc_address) as client:
                    client.detect(points, **options)  # type: ignore[arg-type]
            time.sleep(SETTLE_SECONDS)
        seen = set((folder / "seen").read_text().splitlines())
    files: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for line in seen:
        package, file, _ = line.split("\t")
        files[package][file] += 1
    count = sum(map(len, files.values()))
    print(f"{transport}: {len(seen)} functions in {count} files")
    for package, functions in sorted(files.items()):
        print(f"  {package}: {sum(functions.values())} functions in {len(functions)} files")
        print(
            "".join(f"    {file}: {number}\n" for file, number in sorted(functions.items())), end=""
        )


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    box = (rng.uniform(-1.0, 1.0, (2000, 3)) * (0.02, 0.03, 0.04)).astype(np.float32)
    for transport in ("JSON", "gRPC"):
        trace(transport, box, {"viewpoint": (0.0, 0.0, 0.5), "seed": 1})
