"""`edgegrasp experiment`."""

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from edgegrasp_cli.planners.making import PlannerChoice
    from edgegrasp_sim.benchmark import BenchmarkConfig

Option = typer.Option


def experiment(
    name: Annotated[
        str, typer.Argument(help="robustness, samples, labels, families or baselines: what varies.")
    ],
    output: Annotated[
        Path, Option(help="Folder for its results. The same command again resumes.")
    ] = Path("results/experiment"),
    rounds: Annotated[int, Option(min=1, help="Rounds of each case for each seed.")] = 100,
    seed: Annotated[
        list[int] | None, Option(help="Seed of scenes, views and noise; may be repeated.")
    ] = None,
    scene: Annotated[
        list[str] | None, Option(help="packed or pile; may be repeated. Else both.")
    ] = None,
    protocol: Annotated[str, Option(help="The protocol that is varied.")] = "edgegrasp",
    model: Annotated[
        list[str] | None,
        Option(help="Weights: names or .safetensors files; may be repeated. Else the default."),
    ] = None,
    objects: Annotated[
        Path | None, Option(help="Folder of objects, as for benchmark; else the built-in ones.")
    ] = None,
    split: Annotated[str, Option(help="Which of its objects: test or train.")] = "test",
    num_approach_points: Annotated[int, Option(help="Where they are not varied.")] = 32,
    num_candidates: Annotated[int, Option(help="Where they are not varied.")] = 2000,
    collision: Annotated[str, Option(help="avoid, penalise or ignore.")] = "penalise",
    workers: Annotated[
        int | None, Option(help="Processes that simulate; else one for each core. Same results.")
    ] = None,
    ray: Annotated[
        str | None, Option(help="Address of a Ray cluster to run on; local: this machine.")
    ] = None,
) -> None:
    """Run benchmarks that differ in one thing each, and put their figures side by side.

    Writes experiment.json, table.md, picture.png, and each benchmark's own folder.
    """
    from edgegrasp_cli.planners.making import PlannerChoice
    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.experiments import EXPERIMENTS
    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_sim.protocol import load_protocol
    from edgegrasp_sim.trial import PlannerUnavailableError

    try:
        if name not in EXPERIMENTS:
            raise ValueError(f"name is {name!r}; choose one of {', '.join(EXPERIMENTS)}")
        scenes = [SceneKind(each) for each in scene or [kind.value for kind in SceneKind]]
        plan = EXPERIMENTS[name]
        rules, seeds = load_protocol(protocol), tuple(seed or (0,))
        done: list[dict[str, Any]] = []
        cases = plan(rules, scenes, model or [""], output)
        for number, case in enumerate(cases, 1):
            print(f"{number}/{len(cases)}: {case.name}", flush=True)
            choice = PlannerChoice(
                **{
                    "name": "in-process",
                    "collision": collision,
                    "num_approach_points": num_approach_points,
                    "num_candidates": num_candidates,
                    **case.planner,
                }
            )
            config = BenchmarkConfig(
                case.scene,
                rounds,
                seeds,
                case.protocol,
                case.objects or (objects.resolve() if objects else None),
                split,
            )
            record = _run(config, choice, output / "cases" / case.name, workers, ray)
            done.append({"group": case.group, "value": case.value, **record})
            _write(name, done, output)
    except (PlannerUnavailableError, ValueError, FileNotFoundError, RuntimeError) as error:
        sys.exit(f"edgegrasp experiment: {error}")
    except KeyboardInterrupt:
        sys.exit("edgegrasp experiment: interrupted; the same command goes on from there")
    print((output / "table.md").read_text())


def _run(
    config: "BenchmarkConfig",
    choice: "PlannerChoice",
    where: Path,
    workers: int | None,
    ray: str | None,
) -> dict[str, Any]:
    """Run one case, or what is left of it; returns its record."""
    from edgegrasp_cli.planners.making import planner_of
    from edgegrasp_cli.progress import with_progress
    from edgegrasp_sim.benchmark import available_cores, manifest, run_benchmark
    from edgegrasp_sim.results import ResultFolder, record_of

    folder = ResultFolder(where)
    with planner_of(choice, config.protocol.planning) as made:
        folder.open(manifest(config, made.facts))
        rounds = with_progress(
            config,
            folder,
            lambda on_round: run_benchmark(
                config,
                made.make,
                workers=workers or available_cores(),
                ray=ray,
                folder=folder,
                on_round=on_round,
            ),
        )
    folder.finish(rounds)
    return record_of(folder)


def _write(name: str, cases: list[dict[str, Any]], output: Path) -> None:
    """Write what is known so far, so that an interrupted experiment can be looked at."""
    from edgegrasp_sim.experiments import experiment_figure, experiment_table

    results = {"experiment": name, "command": _command(), "cases": cases}
    (output / "experiment.json").write_text(json.dumps(results, indent=1) + "\n")
    (output / "table.md").write_text(experiment_table(results))
    experiment_figure(results).savefig(output / "picture.png")


def _command() -> str:
    """The command, without the folders of one machine."""
    words = ["edgegrasp", *sys.argv[1:]]
    places = {"--output": "DIR", "--objects": "OBJECTS"}
    for before, place in places.items():
        words = [
            place if number and words[number - 1] == before else word
            for number, word in enumerate(words)
        ]
    return shlex.join(words)
