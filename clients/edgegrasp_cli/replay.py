"""`edgegrasp replay attempt`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

Option = typer.Option

replay = typer.Typer(
    help="Make what a benchmark recorded again.", no_args_is_help=True, add_completion=False
)


@replay.callback()
def _group() -> None:
    """Keeps `attempt` a command of its own."""


@replay.command()
def attempt(
    results: Annotated[Path, typer.Argument(help="Folder that `benchmark --output` wrote.")],
    round: Annotated[int, Option(help="Number of the round, from 0.")] = 0,  # noqa: A002
    number: Annotated[int, Option("--attempt", help="Number of the attempt in it, from 0.")] = 0,
    seed: Annotated[
        int | None, Option(help="Seed of the round; else the benchmark's first.")
    ] = None,
    objects: Annotated[
        Path | None, Option(help="Object folder, if it is elsewhere by now.")
    ] = None,
    picture: Annotated[
        Path | None, Option(help="PNG to write: the cloud seen, and the gripper.")
    ] = None,
    gui: Annotated[bool, Option(help="Show the simulator's window.")] = False,
) -> None:
    """Make one recorded attempt again, in the scene and view it was made in."""
    from edgegrasp_sim.picture import draw_grasps
    from edgegrasp_sim.replay import Replay
    from edgegrasp_sim.report import DrawnAttempt, attempt_title
    from edgegrasp_sim.results import ResultFolder

    try:
        folder = ResultFolder(results)
        first = folder.manifest()["seeds"][0]
        with Replay(folder, objects, gui=gui) as repeated:
            done = repeated.find(first if seed is None else seed, round, number)
            now, seen = repeated.repeat(done.seed, round, number)
            before = done.attempts[number]
            if picture is not None:
                draw_grasps(
                    picture,
                    seen.cloud,
                    [DrawnAttempt.of(before)],
                    camera_position=seen.camera_position,
                    title=attempt_title(done, number),
                )
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"edgegrasp replay: {error}")
    print(attempt_title(done, number))
    same = (now.outcome, now.cause, now.object, now.opening) == (
        before.outcome,
        before.cause,
        before.object,
        before.opening,
    )
    if not same:
        sys.exit(f"edgegrasp replay: it came out otherwise: {now.cause or now.outcome}")
    print("it came out the same")
