"""`edgegrasp benchmark`."""

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edgegrasp_sim.benchmark import BenchmarkConfig, PlannerFactory
    from edgegrasp_sim.results import ResultFolder
    from edgegrasp_sim.trials import Round

Option = typer.Option


def benchmark(
    scene: Annotated[str, Option(help="packed or pile.")] = "pile",
    protocol: Annotated[
        str, Option(help="edgegrasp, giga, vgn, robot, or a .toml file of the same kind.")
    ] = "edgegrasp",
    planner: Annotated[
        str,
        Option(help="server, in-process, edge-sample, oracle, an installed one, module:callable."),
    ] = "server",
    rounds: Annotated[int | None, Option(help="Rounds for each seed; else the protocol's.")] = None,
    seed: Annotated[
        list[int] | None, Option(help="Seed of scenes, views and noise; may be repeated.")
    ] = None,
    objects: Annotated[
        Path | None, Option(help="Folder SCENE/SPLIT/*.urdf; else the built-in objects.")
    ] = None,
    split: Annotated[str, Option(help="Which of its objects: test or train.")] = "test",
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else one is started.")
    ] = None,
    weights: Annotated[list[Path] | None, Option(help="Weights besides those that ship.")] = None,
    model: Annotated[str, Option(help="Weights to use; empty: the default.")] = "",
    num_approach_points: Annotated[
        int | None, Option(help="Approach points sampled; else the protocol's.")
    ] = None,
    num_candidates: Annotated[
        int | None, Option(help="Candidates scored at most; else the protocol's.")
    ] = None,
    collision: Annotated[str, Option(help="avoid, penalise or ignore.")] = "penalise",
    workers: Annotated[int, Option(help="Processes that simulate; results stay the same.")] = 1,
    patience: Annotated[
        float, Option(help="Seconds to go on asking a server that is away.")
    ] = 300.0,
    output: Annotated[
        Path | None,
        Option(help="Folder for manifest, attempts, figures, report. The same again resumes."),
    ] = None,
    report: Annotated[bool, Option(help="Write report.html, which takes a while.")] = True,
    gate: Annotated[
        Path | None, Option(help="summary.json of a result that this one must not fall below.")
    ] = None,
    gui: Annotated[bool, Option(help="Show the simulator's window (one worker).")] = False,
) -> None:
    """Clear simulated clutter with a planner's grasps and count what succeeds.

    GSR: successes / attempts. DR: objects removed / present. The protocol says what a round is.
    """
    from edgegrasp_client import GraspClientError
    from edgegrasp_sim.benchmark import BenchmarkConfig, manifest, run_benchmark
    from edgegrasp_sim.gate import below_gate
    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_sim.protocol import load_protocol
    from edgegrasp_sim.results import ResultFolder, summarise
    from edgegrasp_sim.trials import PlannerUnavailableError

    overrides = {
        name: value
        for name, value in (
            ("num_approach_points", num_approach_points),
            ("num_candidates", num_candidates),
        )
        if value is not None
    }
    try:
        rules = load_protocol(protocol)
        config = BenchmarkConfig(
            SceneKind(scene),
            rules.rounds if rounds is None else rounds,
            tuple(seed or rules.seeds),
            rules,
            objects,
            split,
            patience,
        )
        if gui and workers > 1:
            raise ValueError(f"workers is {workers}; the window shows one: use 1")
        config.object_set()  # a wrong folder shall fail before a server is started
        folder = ResultFolder(output) if output is not None else None
        with _planner(
            planner, config, server, tuple(weights or ()), model, overrides, collision
        ) as (make_planner, description):
            facts = manifest(config, description)
            if folder is not None:
                folder.open(facts)
            done = _with_progress(
                config,
                folder,
                lambda on_round: run_benchmark(
                    config,
                    make_planner,
                    workers=workers,
                    folder=folder,
                    on_round=on_round,
                    gui=gui,
                ),
            )
    except (
        GraspClientError,
        PlannerUnavailableError,
        ValueError,
        FileNotFoundError,
        RuntimeError,
    ) as error:
        sys.exit(f"edgegrasp benchmark: {error}")
    except KeyboardInterrupt:
        again = "; the same command goes on from there" if output is not None else ""
        sys.exit(f"edgegrasp benchmark: interrupted{again}")
    summary = {"scene": scene, "protocol": rules.name, "protocol_version": rules.version}
    summary |= summarise(done)
    if folder is not None:
        folder.finish(done)
        if report:
            _write_report(folder)
    _print_summary(summary, description.get("model") or planner)
    if gate is not None:
        _check_gate(lambda: below_gate(summary, gate))


@contextmanager
def _planner(
    name: str,
    config: "BenchmarkConfig",
    server: str | None,
    weights: tuple[Path, ...],
    model: str,
    overrides: dict[str, int],
    collision: str,
) -> "Iterator[tuple[PlannerFactory, dict[str, Any]]]":
    """What makes the planner, and how to describe it in the manifest."""
    rules = config.protocol.planning
    options = {"model": model, "collision": collision, **overrides}
    if name == "server":
        with _server_planner(server, weights, rules, options) as made:
            yield made
    elif name == "in-process":
        from edgegrasp_cli.planners.in_process import InProcessPlannerFactory
        from edgegrasp_model.catalogue import ModelCatalogue
        from edgegrasp_model.errors import EdgeGraspError

        try:
            used = ModelCatalogue.load(weights).get(model).metadata
        except EdgeGraspError as error:
            raise ValueError(str(error)) from error
        del options["model"]
        facts = {"model": used.name, "digest": used.digest, "options": options}
        yield (
            InProcessPlannerFactory(weights, model, rules, options),
            {"name": name, **facts},
        )
    elif name in ("edge-sample", "oracle"):
        from edgegrasp_cli.planners.edge_sample import CandidateSampler, EdgeSampleFactory
        from edgegrasp_cli.planners.oracle import MAX_TRIES, OracleFactory

        sampler = CandidateSampler(
            overrides.get("num_approach_points", rules.num_approach_points),
            overrides.get("num_candidates", rules.num_candidates),
            rules.voxel_size,
        )
        if name == "oracle":
            yield OracleFactory(sampler), {"name": name, "max_tries": MAX_TRIES, **overrides}
        else:
            yield EdgeSampleFactory(sampler), {"name": name, **overrides}
    else:
        from edgegrasp_cli.planners import NamedPlanner

        make_planner = NamedPlanner(name)
        make_planner()  # a wrong name shall fail here, not in every worker
        yield make_planner, {"name": name}


@contextmanager
def _server_planner(
    server: str | None, weights: tuple[Path, ...], rules: Any, options: dict[str, Any]
) -> "Iterator[tuple[PlannerFactory, dict[str, Any]]]":
    from contextlib import nullcontext

    from edgegrasp_cli.planners.server import ServerPlannerFactory, model_used
    from edgegrasp_client import GraspClient
    from edgegrasp_client.local_server import Addresses, local_server

    flags = [text for path in weights for text in ("--weights", str(path))]
    own = nullcontext(Addresses("", server)) if server else local_server(*flags)
    with own as addresses:
        with GraspClient(addresses.grpc_address) as client:
            used = model_used(client, options["model"])
        yield (
            ServerPlannerFactory(addresses.grpc_address, rules, options, used.digest),
            {
                "name": "server",
                "model": used.name,
                "digest": used.digest,
                "voxel_size": used.voxel_size,
                "options": {name: value for name, value in options.items() if name != "model"},
            },
        )


def _with_progress(
    config: "BenchmarkConfig",
    folder: "ResultFolder | None",
    run: "Callable[[Callable[[Round], None]], list[Round]]",
) -> "list[Round]":
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


def _print_summary(summary: dict[str, Any], planner: str) -> None:
    from rich.console import Console

    def percent(rate: dict[str, Any]) -> str:
        if rate["value"] is None:
            return "undefined"
        low, high = rate["wilson_95"]
        over = ""
        if rate["std_over_seeds"] is not None:
            mean, std = rate["mean_over_seeds"], rate["std_over_seeds"]
            over = f", {100 * mean:.1f} ± {100 * std:.1f} over seeds"
        return f"{100 * rate['value']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]{over}"

    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(
        f"{planner}: GSR {percent(summary['grasp_success_rate'])} "
        f"({summary['successes']} of {summary['attempts']} grasps), "
        f"DR {percent(summary['declutter_rate'])} "
        f"({summary['successes']} of {summary['objects']} objects)"
    )
    failures = {cause: count for cause, count in summary["failures"].items() if count}
    console.print(f"failures: {failures}; rounds ended: {summary['round_ends']}")
    if summary["planner_retries"]:
        console.print(
            f"the planner was unavailable and asked again {summary['planner_retries']} times, "
            f"waiting {summary['planner_waited_seconds']:.1f} s"
        )


def _write_report(folder: "ResultFolder") -> None:
    from edgegrasp_sim.report import write_report

    print(f"report: {write_report(folder)}")


def _check_gate(compare: "Callable[[], list[str]]") -> None:
    try:
        below = compare()
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp benchmark: {error}")
    if below:
        sys.exit("edgegrasp benchmark: below the gate: " + "; ".join(below))
    print("not below the gate")
