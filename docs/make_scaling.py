"""Writes the tables of docs/scaling.md, of `benchmarks.queueing`: `python docs/make_scaling.py`."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pages import filled, table

PAGE = Path(__file__).parent / "scaling.md"
RESULTS = PAGE.parents[1] / "benchmarks/results/queueing.json"
PRICE = 0.04  # of a core and hour
HOURS = 730  # of a month
BYTES = 614_400  # of a request: a depth image of 640 x 480


def page() -> str:
    """The whole page."""
    found = json.loads(RESULTS.read_text())
    blocks = {"compared": compared(found), "waiting": waiting(found), "machines": machines(found)}
    return filled(PAGE.read_text(), blocks)


def compared(found: dict[str, Any]) -> str:
    """The simulation beside what was measured, milliseconds."""
    head = ("clients", "p50 measured", "simulated", "ratio", "p99 measured", "simulated", "ratio")
    rows = []
    for row in found["compared"]:
        cells = [str(row["clients"])]
        for name in ("p50", "p99"):
            for told in ("measured_ms", "simulated_ms"):
                cells.append(f"{row[told][name]:.0f} ms")
            cells.append(f"{row['ratio'][name]:.2f}")
        rows.append(cells)
    return table(head, rows)


def waiting(found: dict[str, Any]) -> str:
    """What requests at random wait, by how busy a machine is."""
    head = ("share of the most", "requests a second", "p50", "p90", "p99")
    rows = (
        [f"{row['share']:.0%}", f"{row['per_second']:.1f}"]
        + [f"{row[name]:.0f} ms" for name in ("p50", "p90", "p99")]
        for row in found["at_random"]
    )
    return table(head, rows)


def machines(found: dict[str, Any]) -> str:
    """Machines, bytes and money by the rate."""
    head = ("requests a second", "cores at work", "machines", "bytes in", "price of a month")
    cores = found["workers"]

    def rows() -> Iterator[list[str]]:
        for row in found["plan"]:
            rate, count = row["per_second"], row["machines"]
            at_work = rate / found["most_per_second"] * cores
            bits = rate * BYTES * 8 / 1e6
            price = count * cores * HOURS * PRICE
            traffic = f"{bits:,.0f} Mbit/s" if bits < 1e4 else f"{bits / 1e3:,.0f} Gbit/s"
            yield [f"{rate:,}", f"{at_work:,.1f}", f"{count:,}", traffic, f"{price:,.0f}"]

    return table(head, rows())


if __name__ == "__main__":
    PAGE.write_text(page())
