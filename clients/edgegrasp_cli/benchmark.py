"""`edgegrasp benchmark`, and `edgegrasp compare` for what it wrote."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edgegrasp_cli.flags import (
    CONNECTION,
    option_flags,
    parse_option_flags,
    takes_flags,
)

if TYPE_CHECKING:
    from edgegrasp_cli.planners.choice import PlannerChoice
    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.results import ResultFolder
    from edgegrasp_sim.trial import Round

Option = typer.Option

# Flags that other commands have too.
Seeds = Annotated[
    list[int] | None, Option("--seed", help="Seed of scenes, views and noise; may be repeated.")
]
Objects = Annotated[
    Path | None,
    Option(help="Folder of SCENE/SPLIT/*.urdf, *.obj or *.stl; else the built-in objects."),
]
Engine = Annotated[
    str | None, Option(help="pybullet or mujoco; else the protocol's, or the one that is there.")
]
Hand = Annotated[
    str | None,
    Option("--gripper", help="Hand to grasp with: a gripper's name or .toml file; else the Panda."),
]
Split = Annotated[str, Option(help="Which of its objects: test or train.")]
Workers = Annotated[int | None, Option(help="Processes; else one for each core. Same results.")]
Ray = Annotated[str | None, Option(help="Address of a Ray cluster to run on; local: this machine.")]
# Options of a detection that the simulation, the protocol or another flag decides.
DECIDED = (
    *("model", "gripper", "seed", "viewpoint", "up", "support", "objects", "workspace"),
    *("top_k", "debug"),
)


@takes_flags(connection=CONNECTION, options=option_flags(*DECIDED, defaults=False))
def benchmark(
    scene: Annotated[str, Option(help="packed, pile, bin, bin-full, table or shelf.")] = "pile",
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
    seeds: Seeds = None,
    objects: Objects = None,
    split: Split = "test",
    engine: Engine = None,
    gripper: Hand = None,
    server: Annotated[
        str | None, Option(help="host:port (gRPC) or http://host:port; else one is started.")
    ] = None,
    weights: Annotated[list[Path] | None, Option(help="Weights besides those that ship.")] = None,
    model: Annotated[
        str, Option(help="Weights to use: a name or a .safetensors file; empty: the default.")
    ] = "",
    workers: Workers = None,
    ray: Ray = None,
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
    *,
    connection: dict[str, Any],
    options: dict[str, Any],
) -> None:
    """Clear simulated clutter with a planner's grasps and count what succeeds.

    GSR: successes / attempts. DR: objects removed / present. The protocol says what a round is.
    Options of the detection are the protocol's, with collision penalise, unless a flag is given.
    """
    from edgegrasp_cli.planners.choice import PlannerChoice
    from edgegrasp_model.gripper import gripper_fields
    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.engine import choose_engine
    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_sim.protocol import load_protocol
    from edgegrasp_sim.results import ResultFolder, below_gate, summarise

    with interruptible("benchmark", resumes=output is not None):
        rules = load_protocol(protocol)
        chosen = choose_engine(engine, rules.engine)
        print(chosen)
        # The Panda's hand has shapes of its own.
        hand = gripper_fields(gripper) if gripper not in (None, "panda") else None
        asked = parse_option_flags(options)
        choice = PlannerChoice(
            planner,
            model,
            tuple(path.resolve() for path in weights or ()),
            server,
            connection,
            asked if hand is None else asked | {"gripper": hand},
        )
        config = BenchmarkConfig(
            SceneKind(scene),
            rules.rounds if rounds is None else rounds,
            tuple(seeds or rules.seeds),
            rules,
            objects.resolve() if objects is not None else None,
            split,
            patience,
            chosen.name,
            hand,
        )
        own_server = planner == "server" and server is None
        if ray not in (None, "local") and own_server:
            raise ValueError(
                f"ray is {ray!r}; the cluster cannot reach a server of this command's own: pass "
                "--server, or --planner in-process"
            )
        folder = ResultFolder(output) if output is not None else None
        done, title = run_rounds(config, choice, folder, workers=workers, ray=ray)
    summary = {
        "scene": scene,
        "engine": chosen.name,
        "protocol": rules.name,
        "protocol_version": rules.version,
    }
    summary |= summarise(done)
    if folder is not None:
        folder.finish(done)
        if report:
            from edgegrasp_sim.report import write_report

            print(f"report: {write_report(folder)}")
    _print_summary(summary, title)
    if gate is not None:
        if below := below_gate(summary, gate):
            sys.exit("edgegrasp benchmark: below the gate: " + "; ".join(below))
        print("not below the gate")


def compare(
    first: Annotated[Path, typer.Argument(help="Folder that `benchmark --output` wrote.")],
    second: Annotated[Path, typer.Argument(help="Another, of the same scenes.")],
    output: Annotated[Path | None, Option(help="JSON file for the figures as well.")] = None,
) -> None:
    """Compare two benchmarks scene by scene, with 95 % confidence intervals."""
    from rich.console import Console
    from rich.table import Table

    from edgegrasp_sim.results import RATE_LABELS, ResultFolder, percent
    from edgegrasp_sim.results import compare as figures_of

    figures = figures_of(ResultFolder(first), ResultFolder(second))
    if output is not None:
        output.write_text(json.dumps(figures, indent=1) + "\n")
    table = Table("", str(first), str(second), "difference, paired")
    for name, label in RATE_LABELS.items():
        row = figures[name]
        difference = {"value": row["difference"], "wilson_95": row["difference_95"]}
        table.add_row(f"{label} %", *map(percent, (row["first"], row["second"], difference)))
    console = Console()
    console.print(table)
    better, worse = figures["second_better"], figures["second_worse"]
    console.print(
        f"{figures['scenes']} scenes: the second removed more objects in {better}, fewer in "
        f"{worse}, as many in {figures['scenes'] - better - worse}.",
        soft_wrap=True,
    )


@contextmanager
def interruptible(command: str, *, resumes: bool) -> Iterator[None]:
    """End the program with a message where workers cannot run, or its user interrupts it."""
    try:
        yield
    except RuntimeError as error:
        sys.exit(f"edgegrasp {command}: {error}")
    except KeyboardInterrupt:
        again = "; the same command goes on from there" if resumes else ""
        sys.exit(f"edgegrasp {command}: interrupted{again}")


def run_rounds(
    config: "BenchmarkConfig",
    choice: "PlannerChoice",
    folder: "ResultFolder | None",
    *,
    workers: int | None,
    ray: str | None,
) -> "tuple[list[Round], str]":
    """Run what is left of a benchmark behind a progress bar.

    Returns:
        All rounds, and the name of the weights or of the planner.
    """
    from rich.console import Console

    from edgegrasp_cli.planners.choice import open_planner
    from edgegrasp_sim.benchmark import manifest, run_benchmark

    # A wrong folder fails before a server is started; meshes are split once for all workers.
    with Console(stderr=True).status("reading objects"):
        config.object_set()
    with open_planner(choice, config.protocol.planning) as planner:
        if folder is not None:
            folder.open(manifest(config, planner.facts))
        with _progress(config, folder) as on_round:
            done = run_benchmark(
                config,
                planner.make,
                workers=workers,
                ray=ray,
                folder=folder,
                on_round=on_round,
            )
    return done, planner.title


@contextmanager
def _progress(
    config: "BenchmarkConfig", folder: "ResultFolder | None"
) -> "Iterator[Callable[[Round], None]]":
    """A bar with the time left; yields what to call after each round."""
    from rich.progress import Progress, TimeElapsedColumn

    from edgegrasp_sim.results import count

    tasks = config.tasks()
    finished = sum(folder.has(*task) for task in tasks) if folder is not None else 0
    came: list[Round] = []
    with Progress(*Progress.get_default_columns(), TimeElapsedColumn()) as progress:
        bar = progress.add_task(config.scene.value, total=len(tasks), completed=finished)

        def on_round(done: "Round") -> None:
            came.append(done)
            successes, attempts, objects = count(came).sum(axis=1)
            text = f"{config.scene.value} GSR {successes}/{attempts} DR {successes}/{objects}"
            if retries := sum(each.retries for each in came):
                text += f" asked again {retries} times"
            progress.update(bar, advance=1, description=text)

        yield on_round


def _print_summary(summary: dict[str, Any], planner: str) -> None:
    from rich.console import Console

    from edgegrasp_sim.results import RATE_LABELS, over_seeds, percent

    console = Console(highlight=False, markup=False, soft_wrap=True)
    gsr, dr = (
        f"{percent(rate)} %, {over_seeds(rate)} over seeds"
        for rate in (summary["grasp_success_rate"], summary["declutter_rate"])
    )
    console.print(
        f"{planner}: GSR {gsr} "
        f"({summary['successes']} of {summary['attempts']} grasps), "
        f"DR {dr} "
        f"({summary['successes']} of {summary['objects']} objects)"
    )
    wide = summary["too_wide"]
    if wide["objects"]:
        gsr, dr = (percent(wide[f"{name}_of_others"]) for name in RATE_LABELS)
        console.print(
            f"{wide['objects']} objects are wider than the hand opens; of the others: "
            f"GSR {gsr} %, DR {dr} %"
        )
    failures = {cause: count for cause, count in summary["failures"].items() if count}
    console.print(f"failures: {failures}; rounds ended: {summary['round_ends']}")
    if summary["planner_retries"]:
        console.print(
            f"the planner was unavailable and asked again {summary['planner_retries']} times, "
            f"waiting {summary['planner_waited_seconds']:.1f} s"
        )
