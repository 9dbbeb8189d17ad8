"""The progress of a benchmark, as a bar."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.results import ResultFolder
    from edgegrasp_sim.trial import Round


def with_progress(
    config: "BenchmarkConfig",
    folder: "ResultFolder | None",
    run: "Callable[[Callable[[Round], None]], list[Round]]",
) -> "list[Round]":
    """Show a bar with the time left while rounds run; `run` is told what to call after each."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    tasks = config.tasks()
    finished = sum(folder.has(*task) for task in tasks) if folder is not None else 0
    attempts = successes = objects = retries = 0
    with Progress(*columns) as progress:
        bar = progress.add_task(config.scene.value, total=len(tasks), completed=finished)

        def on_round(done: "Round") -> None:
            nonlocal attempts, successes, objects, retries
            attempts += len(done.attempts)
            successes += done.successes
            objects += len(done.objects)
            retries += done.retries
            text = f"{config.scene.value} GSR {successes}/{attempts} DR {successes}/{objects}"
            if retries:
                text += f" asked again {retries} times"
            progress.update(bar, advance=1, description=text)

        return run(on_round)
