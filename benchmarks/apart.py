"""Measure in a process of its own, which idles between the measurements."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

END_SECONDS = 30.0


class Apart:
    """A process that measures when it is asked to.

    Args:
        module: Run with `python -m`; calls `measure_when_asked`.
        arguments: Of the module.

    Raises:
        RuntimeError: The process ended at once; it says why on stderr.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            cwd=Path(__file__).parents[1],
        )
        try:
            self._line()  # it is ready
        except RuntimeError:
            self._process.communicate(timeout=END_SECONDS)
            raise

    def seconds(self) -> list[float]:
        """What the module measures, now.

        Raises:
            RuntimeError: The process has ended.
        """
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        measured: list[float] = json.loads(self._line())
        return measured

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._process.args} ended; it says why above")
        return line

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the process."""
        self._process.communicate(timeout=END_SECONDS)


def measure_when_asked(measure: Callable[[], tuple[float, ...]]) -> None:
    """Measure once for each line on stdin, and write the seconds to stdout."""
    print("ready", flush=True)
    for _ in sys.stdin:
        print(json.dumps(measure()), flush=True)
