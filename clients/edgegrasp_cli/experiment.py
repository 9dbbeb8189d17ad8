"""`edgegrasp experiment`."""

import json
import shlex
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edgegrasp_cli.benchmark import (
    DECIDED,
    Engine,
    Objects,
    Ray,
    Seeds,
    Split,
    Workers,
    interruptible,
    run_rounds,
)
from edgegrasp_cli.flags import option_flags, parse_option_flags, takes_flags

if TYPE_CHECKING:
    from edgegrasp_cli.planners.choice import PlannerChoice
    from edgegrasp_sim.experiments import Case

Option = typer.Option
SAMPLES = {"num_approach_points": 32, "num_candidates": 2000}  # unless varied, or flags say other


@takes_flags(options=option_flags(*DECIDED, defaults=False))
def experiment(
    name: Annotated[
        str, typer.Argument(help="robustness, samples, labels, families or baselines: what varies.")
    ],
    output: Annotated[
        Path, Option(help="Folder for its results. The same command again resumes.")
    ] = Path("results/experiment"),
    rounds: Annotated[int, Option(min=1, help="Rounds of each case for each seed.")] = 100,
    seeds: Seeds = None,
    scene: Annotated[
        list[str] | None,
        Option(
            help="packed, pile, bin, bin-full, table, shelf; may be repeated. Else the first two."
        ),
    ] = None,
    protocol: Annotated[str, Option(help="The protocol that is varied.")] = "edgegrasp",
    model: Annotated[
        list[str] | None,
        Option(help="Weights: names or .safetensors files; may be repeated. Else the default."),
    ] = None,
    objects: Objects = None,
    split: Split = "test",
    engine: Engine = None,
    workers: Workers = None,
    ray: Ray = None,
    *,
    options: dict[str, Any],
) -> None:
    """Run benchmarks that differ in one thing each, and put their figures side by side.

    Writes experiment.json, table.md, picture.png, and each benchmark's own folder. Where they are
    not varied there are 32 approach points and 2,000 candidates, unless flags say otherwise.
    """
    from edgegrasp_sim.benchmark import BenchmarkConfig
    from edgegrasp_sim.engine import choose_engine
    from edgegrasp_sim.experiments import cases_of
    from edgegrasp_sim.objects import CLUTTER, SceneKind
    from edgegrasp_sim.protocol import load_protocol
    from edgegrasp_sim.results import ResultFolder, record_of

    with interruptible("experiment", resumes=True):
        scenes = [SceneKind(each) for each in scene or CLUTTER]
        asked = SAMPLES | parse_option_flags(options)
        rules = load_protocol(protocol)
        chosen = choose_engine(engine, rules.engine)
        print(chosen)
        cases = cases_of(name, rules, scenes, model or [""], output)
        done: list[dict[str, Any]] = []
        for number, case in enumerate(cases, 1):
            print(f"{number}/{len(cases)}: {case.name}", flush=True)
            config = BenchmarkConfig(
                case.scene,
                rounds,
                tuple(seeds or (0,)),
                case.protocol,
                case.objects or (objects.resolve() if objects else None),
                split,
                engine=chosen.name,
            )
            folder = ResultFolder(output / "cases" / case.name)
            finished, _ = run_rounds(
                config, _planner(case, asked), folder, workers=workers, ray=ray
            )
            folder.finish(finished)
            done.append({"group": case.group, "value": case.value, **record_of(folder)})
            _write(name, done, output)
    print((output / "table.md").read_text())


def _planner(case: "Case", options: dict[str, Any]) -> "PlannerChoice":
    """The detector in this process, or what else the case says; other words are its options."""
    from edgegrasp_cli.planners.choice import PlannerChoice

    own = {field.name for field in fields(PlannerChoice)} & set(case.planner)
    varied = {word: value for word, value in case.planner.items() if word not in own}
    said = {"name": "in-process"} | {word: case.planner[word] for word in own}
    return PlannerChoice(**said, options=options | varied)


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
    before = ["", *words[:-1]]
    return shlex.join(places.get(flag, word) for flag, word in zip(before, words, strict=True))
