"""`edgegrasp benchmark`."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edgegrasp_cli.connection import TlsCa, TlsCertificate, TlsKey, TokenFile, UseTls

if TYPE_CHECKING:
    from collections.abc import Callable

    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.results import ResultFolder

Option = typer.Option
MAX_RAY_WORKERS = 1024  # as many as the cluster has processors, but for this


def benchmark(
    scene: Annotated[str, Option(help="packed or pile.")] = "pile",
    protocol: Annotated[
        str, Option(help="edgegrasp, giga, vgn, robot, or a .toml file of the same kind.")
    ] = "edgegrasp",
    planner: Annotated[
        str,
        Option(
            help="server, in-process, edge-sample, oracle, oracle-own, an installed one, "
            "module:callable."
        ),
    ] = "server",
    rounds: Annotated[int | None, Option(help="Rounds for each seed; else the protocol's.")] = None,
    seed: Annotated[
        list[int] | None, Option(help="Seed of scenes, views and noise; may be repeated.")
    ] = None,
    objects: Annotated[
        Path | None,
        Option(help="Folder of SCENE/SPLIT/*.urdf, *.obj or *.stl; else the built-in objects."),
    ] = None,
    split: Annotated[str, Option(help="Which of its objects: test or train.")] = "test",
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else one is started.")
    ] = None,
    token_file: TokenFile = None,
    tls: UseTls = False,
    tls_ca: TlsCa = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    weights: Annotated[list[Path] | None, Option(help="Weights besides those that ship.")] = None,
    model: Annotated[
        str, Option(help="Weights to use: a name or a .safetensors file; empty: the default.")
    ] = "",
    num_approach_points: Annotated[
        int | None, Option(help="Approach points sampled; else the protocol's.")
    ] = None,
    num_candidates: Annotated[
        int | None, Option(help="Candidates scored at most; else the protocol's.")
    ] = None,
    collision: Annotated[str, Option(help="avoid, penalise or ignore.")] = "penalise",
    min_score: Annotated[
        float, Option(min=0.0, max=1.0, help="Least score of a grasp; below it, another view.")
    ] = 0.0,
    workers: Annotated[
        int | None, Option(help="Processes that simulate; else one for each core. Same results.")
    ] = None,
    ray: Annotated[
        str | None, Option(help="Address of a Ray cluster to run on; local: this machine.")
    ] = None,
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
    from edgegrasp_cli.planners.making import PlannerChoice, planner_of
    from edgegrasp_cli.progress import with_progress
    from edgegrasp_client import GraspClientError
    from edgegrasp_sim.benchmark import BenchmarkConfig, manifest, run_benchmark
    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_sim.protocol import load_protocol
    from edgegrasp_sim.results import ResultFolder, below_gate, summarise
    from edgegrasp_sim.trial import PlannerUnavailableError

    choice = PlannerChoice(
        planner,
        model,
        tuple(path.resolve() for path in weights or ()),
        server,
        (token_file, tls, tls_ca, tls_certificate, tls_key),
        collision,
        num_approach_points,
        num_candidates,
        min_score,
    )
    try:
        rules = load_protocol(protocol)
        config = BenchmarkConfig(
            SceneKind(scene),
            rules.rounds if rounds is None else rounds,
            tuple(seed or rules.seeds),
            rules,
            objects.resolve() if objects is not None else None,
            split,
            patience,
        )
        processes = _processes(
            workers, gui=gui, ray=ray, own_server=planner == "server" and server is None
        )
        _prepare_objects(config)  # a wrong folder shall fail before a server is started
        folder = ResultFolder(output) if output is not None else None
        with planner_of(choice, rules.planning) as made:
            if folder is not None:
                folder.open(manifest(config, made.facts))
            done = with_progress(
                config,
                folder,
                lambda on_round: run_benchmark(
                    config,
                    made.make,
                    workers=processes,
                    ray=ray,
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
    _print_summary(summary, made.title)
    if gate is not None:
        _check_gate(lambda: below_gate(summary, gate))


def _processes(workers: int | None, *, gui: bool, ray: str | None, own_server: bool) -> int:
    """How many worker processes to use.

    Raises:
        ValueError: flags that do not go together.
    """
    from edgegrasp_sim.benchmark import available_cores

    if gui and (workers or 1) > 1:
        raise ValueError(f"workers is {workers}; the window shows one: use 1")
    if gui and ray is not None:
        raise ValueError(f"ray is {ray!r}; the window is this machine's: leave it out")
    if ray not in (None, "local") and own_server:
        raise ValueError(
            f"ray is {ray!r}; the cluster cannot reach a server of this command's own: pass "
            "--server, or --planner in-process"
        )
    if gui:
        return 1
    if workers is None:
        return MAX_RAY_WORKERS if ray is not None else available_cores()
    return workers


def _prepare_objects(config: "BenchmarkConfig") -> None:
    """Read the objects; meshes are taken apart at this moment, once for all workers."""
    from rich.console import Console

    with Console(stderr=True).status("reading objects"):
        config.object_set()


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
