"""The program as a whole: its help, and what it says where something is missing."""

import importlib.metadata
import json
import os
import shlex
import signal
import sys
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.cli.commands import invoke, refused, run
from tests.programs import EDGEGRASP, started
from tests.programs import run as run_program
from typer.testing import CliRunner

from edgegrasp.v1 import grasp_pb2
from edgegrasp_cli import main
from edgegrasp_service.errors import InvalidRequest, to_problem
from edgegrasp_service.worker.process import Answer, Facts, Job

HEAVY = {"torch", "open3d", "grpc", "pybullet", "mujoco", "fastapi", "uvicorn", "httpx"}
HEAVY |= {"matplotlib"}


def loaded_by(*commands: list[str]) -> tuple[str, set[str]]:
    """What commands print, and the modules that a fresh interpreter has loaded for them."""
    program = (
        "import sys\nfrom edgegrasp_cli.main import main\n"
        f"for words in {commands!r}:\n"
        "    sys.argv = ['edgegrasp', *words]\n"
        "    try: main()\n"
        "    except SystemExit as end: assert not end.code\n"
        "print('LOADED', *sys.modules)"
    )
    shown, _, loaded = run_program(sys.executable, "-c", program).stdout.rpartition("LOADED")
    return shown, set(loaded.split())


def test_help_lists_the_commands_and_loads_nothing_heavy() -> None:
    shown, loaded = loaded_by(["--help"])
    assert all(name in shown for name in main.COMMANDS)
    assert not loaded & (HEAVY | {"numpy", "scipy", "pydantic"})
    names = set(main.COMMANDS) - {"open-inference"}  # a gateway, which imports what it serves
    shown, loaded = loaded_by(*([name, "--help"] for name in names))
    assert all(f"edgegrasp {name} " in shown for name in names)
    assert not loaded & HEAVY


def test_version_short_help_completion_and_an_unknown_command() -> None:
    assert "Did you mean 'detect'?" in invoke(2, "detec")
    assert loaded_by(["--version"])[0] == f"edgegrasp {importlib.metadata.version('edgegrasp')}\n"
    for words in (["-h"], ["detect", "-h"]):
        assert "edgegrasp detect cloud.ply" in " ".join(run(*words).split())
    bash = {"_EDGEGRASP_COMPLETE": "source_bash"}
    assert "complete" in CliRunner().invoke(main.app, [], prog_name="edgegrasp", env=bash).output
    asked = {"COMP_WORDS": "edgegrasp detect --viewp", "COMP_CWORD": "2"}
    asked |= {"_EDGEGRASP_COMPLETE": "complete_bash"}
    done = CliRunner().invoke(main.app, [], prog_name="edgegrasp", env=asked)
    assert "--viewpoint" in done.output.split()


def test_help_is_shown_on_a_terminal_that_does_not_know_every_character() -> None:
    environment = {"PYTHONIOENCODING": "ascii"}
    assert "--depth" in run_program(*EDGEGRASP, "detect", "--help", env=environment).stdout


def test_a_full_disk_is_named_and_a_closed_pipe_is_not() -> None:
    for words in (["--version"], ["--help"]):
        shown = shlex.join([*EDGEGRASP, *words])
        full = run_program("bash", "-c", f"{shown} > /dev/full", code=1).stderr
        assert "No space left on device\n" in full
        assert full.count("\n") == 1
        closed = f"set -o pipefail; {{ sleep 0.1; {shown}; }} | true"
        assert run_program("bash", "-c", closed, code=1).stderr == ""


@pytest.mark.parametrize(
    ("missing", "words", "extra"),
    [
        ("edgegrasp_client", ["models", "--server", "127.0.0.1:1"], "service"),
        ("edgegrasp_sim.report", ["replay", "attempt", "FOLDER"], "service,sim"),
        ("edgegrasp_cli.serve", ["serve"], "service"),
        ("matplotlib", ["detect", "absent.ply", "--picture", "grasps.png"], "view"),
        ("open3d", ["train-scene", "FOLDER", "--run", "FOLDER"], "open3d,train"),
        ("typer", [], "cli"),  # the command line itself
    ],
)
def test_a_missing_package_names_the_extra(missing, words, extra) -> None:
    program = (
        f"import sys; sys.modules[{missing!r}] = None; sys.argv = {['edgegrasp', *words]}; "
        "from edgegrasp_cli.main import main; main()"
    )
    said = run_program(sys.executable, "-c", program, code=1).stderr
    assert f"pip install 'edgegrasp[{extra}]'" in said


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        (["generate-data", "FOLDER"], "'edgegrasp[sim]'"),
        (["benchmark-tracking"], "mujoco"),
        (["generate-scenes", "FOLDER", "--objects", "FOLDER"], "pybullet"),
    ],
)
def test_a_missing_engine_is_named(words: list[str], missing: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert f"edgegrasp {words[0]}: " in (said := refused(*words))
    assert f"installed: pip install {missing}" in said


SERVE = ("serve", "--http-port", 0, "--grpc-port", 0, "--robots", "fr3")


@pytest.mark.parametrize("words", [SERVE, ("robot", "check", "fr3")])
def test_arms_are_an_extra(words: tuple[object, ...], tmp_path: Path) -> None:
    (tmp_path / "roboplan.py").write_text("raise ModuleNotFoundError('no arms', name='roboplan')")
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    ended = run_program(*EDGEGRASP, *words, code=1, env=os.environ | {"PYTHONPATH": paths})
    assert f"edgegrasp {words[0]}: roboplan is not installed" in ended.stderr
    assert "pip install 'edgegrasp[robot]'\n" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("transport", ["http", "grpc"])
def test_a_recorded_request_is_answered_again(transport, monkeypatch) -> None:
    def body(model: str, seconds: float) -> bytes:
        if transport == "http":
            return json.dumps({"model": model, "seconds": {"total": seconds}}).encode()
        response = grasp_pb2.DetectGraspsResponse(model=model, seconds={"total": seconds})
        return response.SerializeToString()

    def replay(path: Path, settings: object) -> tuple[Job, Answer, Answer]:
        job, facts = Job("DetectGrasps", transport, b"", 60.0), Facts(grasps=7)
        if path.stem == "errors":
            first, second = (to_problem(InvalidRequest("cloud", value, "")) for value in "ab")
            return job, Answer(b"", facts, first), Answer(b"", facts, second)
        return job, Answer(body("plus", 1.0), facts), Answer(body(path.stem, 2.0), facts)

    monkeypatch.setattr("edgegrasp_lab.replay.answer_again", replay)
    assert "7 grasps\nthe answer is the same" in run("replay", "request", "plus.job")
    for differing in ("small.job", "errors.job"):
        assert "differs" in refused("replay", "request", differing)


def test_a_scene_is_viewed_until_ctrl_c(tmp_path: Path) -> None:
    assert "No such file" in refused("view", "absent.ply", "--no-browser")
    assert "or --depth" in refused("view", "absent.ply", "--depth", "depth.png", "--no-browser")
    depth, color = tmp_path / "frame.npy", tmp_path / "color" / "frame.npy"
    color.parent.mkdir()
    np.save(depth, np.full((4, 6), 500, np.uint16))
    np.save(color, np.full((4, 6, 3), 90, np.uint8))
    flags = ("--depth", depth, "--color", color, "--intrinsics", "30,30,3,2", "--no-browser")
    with started(*EDGEGRASP, "view", *flags) as viewer:
        address = viewer.stdout.readline().split()[0]
        sample = httpx.get(f"{address}samples/samples.json").json()[0]
        assert sample["intrinsics"] == "30,30,3,2"
        files = [httpx.get(f"{address}samples/{name}").content for name in sample["files"]]
        assert files == [depth.read_bytes(), color.read_bytes()]
        assert httpx.get(address).status_code == 200
        viewer.send_signal(signal.SIGINT)
        assert viewer.wait(timeout=30) == 0
    with pytest.raises(httpx.ConnectError):
        httpx.get(address)
