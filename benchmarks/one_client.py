"""A client that waits: `python -m benchmarks.one_client TRANSPORT ADDRESS`.

It sends one cloud for each line on stdin, and writes the seconds until there was an answer.
"""

import sys
import time

from benchmarks.apart import measure_when_asked
from benchmarks.in_process import OPTIONS, POINTS
from benchmarks.senders import cloud, sender


def main(transport: str, address: str) -> None:
    """Send when asked to."""
    with sender(transport, address, cloud(POINTS, seed=0), OPTIONS) as one:

        def seconds() -> tuple[float]:
            start = time.perf_counter()
            told = one.send(None)
            if told.code != "OK":
                raise RuntimeError(f"{transport}: {told.code}")
            return (time.perf_counter() - start,)

        measure_when_asked(seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
