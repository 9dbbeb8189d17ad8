"""The report of a benchmark, an HTML file with tables and pictures, and repeated attempts."""

import base64
import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

from edgegrasp_camera.picture import PANDA_Z, Camera, Picture
from edgegrasp_sim.benchmark import BenchmarkConfig
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import protocol_from
from edgegrasp_sim.results import RATE_LABELS, ResultFolder, planner_title, rate_text, seed_spread
from edgegrasp_sim.trial import Attempt, PlannedGrasp, Round, RoundDriver

PICTURES = 6
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1120px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { padding: .3em .9em .3em 0; text-align: left; border-bottom: 1px solid #e6e9ed; }
img { max-width: 100%; margin: 1.2em 0; }
"""
Row = Sequence[object]


def repeat(
    folder: ResultFolder,
    seed: int,
    index: int,  # of the round
    number: int,  # of the attempt in it
    objects: Path | None = None,  # their folder, if it has moved
) -> tuple[Round, Attempt, Observation]:
    """Repeat a round up to an attempt; raises FileNotFoundError or ValueError.

    Returns the recorded round, the repeated attempt, and the observation before it.
    """
    facts = folder.manifest()
    run, known = facts["run"], facts["objects_folder"]
    if "arm" in run:
        raise ValueError(f"{folder.path} holds attempts of an arm, whose motions are not kept")
    done = next((one for one in folder.rounds() if (one.seed, one.index) == (seed, index)), None)
    if done is None:
        raise ValueError(f"round is {index} of seed {seed}; choose one of {folder.path / 'rounds'}")
    if not 0 <= number < len(done.attempts):
        raise ValueError(f"attempt is {number}; the round has {len(done.attempts)}, from 0 on")
    config = BenchmarkConfig(
        SceneKind(run["scene"]),
        facts["rounds"],
        tuple(facts["seeds"]),
        protocol_from(run["protocol"]),
        objects or (known and Path(known)),
        facts["split"],
        run["engine"],
        run.get("gripper"),
    )
    with config.simulation(run["objects"]["digest"]) as simulation:
        driver = RoundDriver(simulation, config.scene, config.protocol, seed=seed, index=index)
        for recorded in done.attempts[: number + 1]:
            seen = driver.observe()
            while driver.view < recorded.view:  # views in which no grasp was found
                seen = driver.observe()
            grasp = PlannedGrasp(recorded.T_world_hand, recorded.score, recorded.width)
            repeated = driver.execute(grasp)
    return done, repeated, seen


def write_report(folder: ResultFolder, summary: dict[str, Any]) -> Path:
    """Write `report.html` into a finished result folder."""
    rounds, facts = folder.rounds(), folder.manifest()
    pictures = () if "arm" in facts["run"] else _failure_pictures(folder, rounds)
    protocol = f"protocol {summary['protocol']}, version {summary['protocol_version']}"
    title = f"{planner_title(facts['run']['planner'])} on {summary['scene']} scenes, {protocol}"
    parts = [
        table([("figure", ""), *key_figures(summary)]),
        *pictures,
        "<h2>Objects</h2>",
        table(_object_rows(summary)),
        "<h2>Conditions</h2><details><summary>every constant, version and digest</summary>",
        f"<pre>{escape(json.dumps(facts, indent=1))}</pre></details>",
    ]
    path = folder.path / "report.html"
    path.write_text(page(title, parts), "utf-8")
    return path


def key_figures(summary: dict[str, Any]) -> Iterator[Row]:
    """The figures of a benchmark, each with its name."""
    rates = [summary[name] for name in RATE_LABELS]
    for name, label in RATE_LABELS.items():
        yield f"{label} % [95 % interval]", rate_text(summary[name])
    for seed in rates[0]["by_seed"]:
        yield f"seed {seed}: GSR, DR", ", ".join(_share(rate["by_seed"][seed]) for rate in rates)
    yield "mean ± standard deviation over seeds: GSR, DR", ", ".join(map(seed_spread, rates))
    yield "grasps held", f"{summary['successes']} of {summary['attempts']}"
    yield "of those another object than the one aimed at", summary["wrong_object_successes"]
    yield "objects", summary["objects"]
    if number := (wide := summary["too_wide"])["objects"]:
        of_others = ", ".join(rate_text(wide[f"{name}_of_others"]) for name in RATE_LABELS)
        yield f"without {number} objects wider than the hand opens: GSR, DR", of_others
    yield "failures", _counted(summary["failures"])
    yield "ends of rounds", _counted(summary["round_ends"])
    if times := summary["planning_seconds"]:
        yield "planning, median", f"{times['median']:.2f} s"
    if arm := summary["arm"]:
        reached = f"{arm['scenes_with_a_reachable_grasp']} of {summary['rounds']}"
        yield "scenes with a grasp within the arm's reach", reached
        yield "motions that touched something before the pregrasp", arm["touched_on_the_way"]
        yield "of those, something that the camera had seen", arm["touched_seen"]
        yield "a motion out and home, median", f"{arm['motion_seconds']:.1f} s"
        yield "picks per hour", f"{arm['picks_per_hour']:.0f}"


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.items() if number) or "none"


def attempt_title(done: Round, number: int) -> str:
    """One line about an attempt and its outcome."""
    attempt = done.attempts[number]
    outcome = f"{attempt.object} removed" if attempt.success else str(attempt.cause)
    target = attempt.target or "nothing between the fingers"
    return (
        f"seed {done.seed}, round {done.index}, attempt {number}: {outcome} "
        f"(aimed at {target}; score {attempt.score:.2f})"
    )


def draw_attempt(
    path: Path, hand: dict[str, Any] | None, done: Round, number: int, seen: Observation
) -> None:
    """Write a picture of an attempt in the cloud seen before it; `hand` None: the Panda's."""
    z = PANDA_Z
    if hand is not None:
        z = max(high[2] for _, high in hand["hand"]["boxes"]), hand["tip_z"]
    view = Camera.facing(seen.cloud, seen.camera_position)
    picture = Picture(view, seen.cloud, title=attempt_title(done, number))
    picture.grasps([done.attempts[number]], z)
    picture.save(path)


def page(title: str, parts: Iterable[str]) -> str:
    """An HTML page: a title, which is escaped, and parts in HTML."""
    title = escape(title)
    head = "<!doctype html><html lang=en><head><meta charset=utf-8>"
    head += "<meta name=viewport content='width=device-width, initial-scale=1'>"
    start = f"{head}<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>"
    return "\n".join([start, *parts, "</body></html>\n"])


def table(rows: Iterable[Row]) -> str:
    """A table whose first row is its head."""
    lines = []
    for number, row in enumerate(rows):
        kind = "td" if number else "th"
        lines.append("".join(f"<{kind}>{escape(str(cell))}</{kind}>" for cell in row))
    return "<table><tr>" + "</tr>\n<tr>".join(lines) + "</tr></table>"


def image(kind: str, content: bytes, text: str) -> str:
    """An embedded picture of a kind such as png, with alternative text."""
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return f"<img src='{source}' alt='{escape(text, quote=True)}'>"


def _object_rows(summary: dict[str, Any]) -> Iterator[Row]:
    yield "object", "present", "removed", "DR %", "aimed at", "held", "GSR %"
    objects = summary["objects_by_name"].items()
    for name, row in sorted(objects, key=lambda item: item[1]["removed"] / item[1]["present"]):
        present, removed, aimed, held = row.values()
        rates = _share(removed / present), _share(held / aimed if aimed else None)
        yield name, present, removed, rates[0], aimed, held, rates[1]


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _failure_pictures(folder: ResultFolder, rounds: Sequence[Round]) -> Iterator[str]:
    """Pictures of failed attempts: one for each cause, then more, `PICTURES` in all."""
    before: Counter[str] = Counter()  # failures with the same cause
    failed = []
    for done in rounds:
        for number, attempt in enumerate(done.attempts):
            if not attempt.success:
                before[str(attempt.cause)] += 1
                failed.append((before[str(attempt.cause)], done, number))
    hand = folder.manifest()["run"].get("gripper")
    for _, done, number in sorted(failed, key=lambda each: each[0])[:PICTURES]:
        _, _, seen = repeat(folder, done.seed, done.index, number)
        with tempfile.NamedTemporaryFile(suffix=".jpg") as file:
            draw_attempt(Path(file.name), hand, done, number, seen)
            yield image("jpeg", file.read(), attempt_title(done, number))
