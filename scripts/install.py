"""`pip install` that shows how far it is: a bar on a terminal, else a line now and then.

usage: PYTHON scripts/install.py CONSTRAINTS ARGUMENTS...    arguments of pip install

Counts the packages that pip has chosen, then those that it has unpacked, of as many as the
constraints name. Needs nothing but pip, which brings rich.
"""

import subprocess
import sys
import sysconfig
import threading
from pathlib import Path

from pip._vendor.rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

COLUMNS = (TextColumn("{task.description:40.40}"), BarColumn(), TimeRemainingColumn())
EVERY = 25  # packages between two lines where there is no terminal


class Shown:
    """A bar, or lines, for so many packages to be chosen and then unpacked."""

    def __init__(self, packages: int) -> None:
        self.bar = Progress(*COLUMNS, disable=not sys.stdout.isatty())
        self.task = self.bar.add_task("starting", total=2 * packages)
        self.packages = packages
        self.last = -1

    def show(self, what: str, chosen: int, unpacked: int) -> None:
        self.bar.update(self.task, description=what, completed=chosen + unpacked)
        if self.bar.disable and (chosen + unpacked) // EVERY > self.last:
            self.last = (chosen + unpacked) // EVERY
            print(
                f"{what} ({chosen} of about {self.packages} chosen, {unpacked} unpacked)",
                flush=True,
            )


def main(constraints: str, *arguments: str) -> int:
    lines = Path(constraints).read_text().splitlines()
    shown = Shown(sum("==" in line for line in lines))
    folder = Path(sysconfig.get_path("purelib"))
    before = len(list(folder.glob("*.dist-info")))
    words = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-color"]
    plain = ["--no-compile", "--progress-bar", "off"]  # compiled on import, what is used
    command = [*words, "install", *plain, "--constraint", constraints, *arguments]
    chosen: set[str] = set()
    unpacking = threading.Event()
    with shown.bar, subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as pip:
        assert pip.stdout is not None

        def watch() -> None:
            while pip.poll() is None:
                if unpacking.wait(0.5):
                    unpacked = len(list(folder.glob("*.dist-info"))) - before
                    shown.show("unpacking into .venv", len(chosen), max(unpacked, 0))
                    threading.Event().wait(0.5)

        watcher = threading.Thread(target=watch)
        watcher.start()
        for line in pip.stdout:
            first, _, rest = line.strip().partition(" ")
            if first in ("Collecting", "Processing"):
                chosen.add(rest.split(" ")[0])
                shown.show(f"choosing {rest.split(' ')[0]}", len(chosen), 0)
            elif line.startswith("Installing collected packages"):
                shown.packages = len(chosen)  # an extra alone needs fewer than all
                shown.bar.update(shown.task, total=2 * shown.packages)
                unpacking.set()
        watcher.join()
        if pip.returncode == 0:
            shown.bar.update(shown.task, description="installed", completed=2 * shown.packages)
    return pip.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
