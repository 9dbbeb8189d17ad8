"""The picture of a soak: memory over the requests."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot


def draw(results: dict[str, Any], path: Path) -> None:
    """Draw the server's memory after each hundredth of the requests."""
    figure, axis = pyplot.subplots(figsize=(7, 3.5), constrained_layout=True)
    requests, memory = zip(*results["memory"], strict=True)
    axis.plot(requests, memory)
    axis.set(
        title=f"{results['memory_slope_mb_per_1000']:+.3f} MB per 1,000 requests after a fifth",
        xlabel="requests",
        ylabel="resident memory of the server, MB",
        ylim=(0, 1.2 * max(memory)),
    )
    figure.savefig(path, dpi=90)
    pyplot.close(figure)
