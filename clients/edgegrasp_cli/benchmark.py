"""`edgegrasp benchmark`."""

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

Option = typer.Option


def benchmark(
    scene: Annotated[str, Option(help="packed or pile.")] = "pile",
    rounds: Annotated[int, Option(help="Rounds of clutter removal.")] = 20,
    seed: Annotated[int, Option(help="Seed of scenes, views, noise and policy.")] = 0,
    objects: Annotated[
        Path | None, Option(help="Folder SCENE/SPLIT/*.urdf; else the built-in objects.")
    ] = None,
    split: Annotated[str, Option(help="Which of its objects: test or train.")] = "test",
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else one is started.")
    ] = None,
    weights: Annotated[
        list[Path] | None, Option(help="Weights for the server that is started.")
    ] = None,
    model: Annotated[str, Option(help="Weights to use; empty: the server's default.")] = "",
    num_approach_points: Annotated[int, Option(help="Approach points sampled.")] = 32,
    num_candidates: Annotated[int, Option(help="Candidates scored at most.")] = 2000,
    collision: Annotated[str, Option(help="avoid, penalise or ignore.")] = "penalise",
    workers: Annotated[int, Option(help="Processes that simulate; results stay the same.")] = 1,
    output: Annotated[Path | None, Option(help="JSON file for every attempt and figure.")] = None,
) -> None:
    """Clear simulated clutter with a server's grasps and count what succeeds.

    Each round sets up 5 objects and looks once before every grasp; it ends when the table is
    empty or after two failures in a row. GSR: successes / attempts. DR: objects removed / present.
    """
    from edgegrasp_cli.planners import REQUEST_SECONDS, ServerPlanner, ServerPlannerFactory
    from edgegrasp_client import GraspClient, GraspClientError
    from edgegrasp_client.local_server import Addresses, local_server
    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.objects import SceneKind

    options: dict[str, Any] = {
        "model": model,
        "num_approach_points": num_approach_points,
        "num_candidates": num_candidates,
        "collision": collision,
    }
    flags = [text for path in weights or [] for text in ("--weights", str(path))]
    try:
        config = BenchmarkConfig(SceneKind(scene), rounds, seed, objects, split)
        config.object_set()  # a wrong folder shall fail before a server is started
        own = nullcontext(Addresses("", server)) if server else local_server(*flags)
        with (
            own as addresses,
            GraspClient(addresses.grpc_address, timeout=REQUEST_SECONDS) as client,
        ):
            used = next(m for m in client.models() if m.name == model or (m.default and not model))
            if workers == 1:
                planner = ServerPlanner(client, options)
                report = _with_progress(config, lambda: planner, workers)
            else:
                factory = ServerPlannerFactory(addresses.grpc_address, options)
                report = _with_progress(config, factory, workers)
    except (GraspClientError, ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp benchmark: {error}")
    if output is not None:
        report.write_json(output, options | {"model": used.name, "digest": used.digest})
    _print_summary(report.summary(), used.name)


def _with_progress(config: Any, factory: Any, workers: int) -> Any:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from edgegrasp_sim.benchmark import run_benchmark

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    attempts = successes = objects = 0
    with Progress(*columns) as progress:
        task = progress.add_task(config.scene.value, total=config.rounds)

        def on_round(done: Any) -> None:
            nonlocal attempts, successes, objects
            attempts += len(done.attempts)
            successes += done.successes
            objects += done.objects
            text = f"{config.scene.value} GSR {successes}/{attempts} DR {successes}/{objects}"
            progress.update(task, advance=1, description=text)

        return run_benchmark(config, factory, workers=workers, on_round=on_round)


def _print_summary(summary: dict[str, Any], model: str) -> None:
    from rich.console import Console

    def percent(value: float | None) -> str:
        return "undefined" if value is None else f"{100 * value:.1f} %"

    console = Console(highlight=False)
    console.print(
        f"{model}: GSR {percent(summary['grasp_success_rate'])} "
        f"({summary['successes']} of {summary['attempts']} grasps), "
        f"DR {percent(summary['declutter_rate'])} "
        f"({summary['successes']} of {summary['objects']} objects)"
    )
    console.print(f"failures: {summary['failures']}; rounds ended: {summary['round_ends']}")
