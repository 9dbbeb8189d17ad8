"""`edgegrasp replay`: repeat a benchmark's attempt, or a request recorded by a server."""

import json
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from google.protobuf import json_format
from rich.console import Console
from typer import Argument, Option, Typer

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.settings import Settings, load_settings
from edgegrasp_service.worker import answer as worker
from edgegrasp_service.worker.process import Answer, Job, receive
from edgegrasp_sim.report import attempt_title, draw_attempt, repeat
from edgegrasp_sim.results import ResultFolder

replay = Typer(
    help="Repeat a recording: an attempt of a benchmark, or a request.",
    no_args_is_help=True,
    add_completion=False,
)


@replay.command()
def attempt(
    results: Annotated[Path, Argument(help="Folder that `benchmark --output` wrote.")],
    round: Annotated[int, Option(help="Number of the round, from 0.")] = 0,  # noqa: A002
    number: Annotated[int, Option("--attempt", help="Number of the attempt in it, from 0.")] = 0,
    seed: Annotated[
        int | None, Option(help="Seed of the round; default: the benchmark's first.")
    ] = None,
    objects: Annotated[Path | None, Option(help="Object folder, if it has moved.")] = None,
    picture: Annotated[
        Path | None, Option(help="PNG to write: the observed cloud and the gripper.")
    ] = None,
) -> None:
    """Repeat one recorded attempt, in its scene and view."""
    folder = ResultFolder(results)
    first = folder.manifest()["seeds"][0]
    with Console(stderr=True).status("Making the attempt again…"):
        done, now, seen = repeat(folder, first if seed is None else seed, round, number, objects)
    before, title = done.attempts[number], attempt_title(done, number)
    if picture is not None:
        draw_attempt(picture, folder.manifest()["run"].get("gripper"), done, number, seen)
    print(title)
    if any(getattr(now, name) != getattr(before, name) for name in ("cause", "object", "opening")):
        sys.exit(f"edgegrasp replay: the result differs: {now.cause or 'success'}")
    print("the result is the same")


@replay.command()
def request(
    file: Annotated[Path, Argument(help="A file that a server with --record-folder wrote.")],
    config: Annotated[Path | None, Option(help="TOML file with the server's settings.")] = None,
) -> None:
    """Answer a recorded request again, in this process, and compare with the recorded answer.

    Weights and limits are those of --config and of EDGEGRASP_* variables, as for `serve`.
    """
    job, recorded, answer = answer_again(file, load_settings(config))
    print(f"{answer.facts.grasps} grasps" if answer.error is None else answer.error.detail)
    before, now = ((one.error, _without_times(job, one.body)) for one in (recorded, answer))
    if now != before:
        sys.exit("edgegrasp replay: the answer differs from the recorded one")
    print("the answer is the same")


def answer_again(file: Path, settings: Settings) -> tuple[Job, Answer, Answer]:
    """A recorded request, the recorded answer, and the answer now; raises ValueError."""
    job = recorded = None
    # For other files.
    wrong = LookupError, MemoryError, OverflowError, RecursionError, TypeError, ValueError
    with file.open("rb") as stream, suppress(*wrong):
        job, recorded = receive(stream), receive(stream)
    outcome = isinstance(job, Job) and job.method == "RecordOutcome"  # it would be recorded twice
    if outcome or not isinstance(job, Job) or not isinstance(recorded, Answer):
        raise ValueError(f"{file} is not a recorded request of grasps")
    job = replace(job, remaining=settings.max_request_seconds)
    return job, recorded, worker.answer(job, worker.load_catalogue(settings), settings)


def _without_times(job: Job, body: bytes) -> Any:
    """An answer without the seconds it took; None for an error, whose body is empty."""
    if not body:
        return None
    if job.transport == "http":
        answer = json.loads(body)
    else:
        message = getattr(grasp_pb2, f"{job.method}Response").FromString(body)
        answer = json_format.MessageToDict(message)
    answer.pop("seconds", None)
    return answer
