"""The examples run as their first lines say."""

import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.cloud_files import block_obj
from tests.programs import EDGEGRASP, ROOT, run

EXAMPLES = ROOT / "examples"


def test_demo_prints_ranked_grasps_of_both_transports_and_writes_a_picture(tmp_path: Path) -> None:
    shown = example("demo.py", "--output", tmp_path)
    grpc_table, rest_table = re.split(r"\n\d+ grasps over ", shown)[1:]
    ranked = re.compile(r"^ +(\d+)  (0\.\d+)  ", re.MULTILINE)
    assert len(ranked.findall(grpc_table)) >= 10
    assert ranked.findall(grpc_table) == ranked.findall(rest_table)
    assert "the same grasps" in shown
    executed = r"Executed the best one in the simulator: it (held|did not hold)\."
    assert re.search(executed, rest_table)
    assert (tmp_path / "grasps.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "scene.ply").read_bytes().startswith(b"ply\n")


def example(name: str, *words: object) -> str:
    """What an example prints."""
    return run(sys.executable, EXAMPLES / name, *words).stdout


def test_cpp_example_is_built_and_prints_five_grasps(dummy_server, tmp_path: Path) -> None:
    needed = ("cmake", "c++", "protoc", "grpc_cpp_plugin", "pkg-config")
    there = all(map(shutil.which, needed))
    if not there or subprocess.run(["pkg-config", "--exists", "grpc++"]).returncode:
        pytest.skip(f"{needed} or grpc++ is not installed, see examples/cpp/CMakeLists.txt")
    build = tmp_path / "build"
    run("cmake", "-S", EXAMPLES / "cpp", "-B", build)
    run("cmake", "--build", build, "--parallel", 2)
    depth = tmp_path / "depth.raw"
    depth.write_bytes(np.full((48, 64), 600, "<u2").tobytes())
    camera = (depth, 64, 48, 60, 60, 32, 24)
    done = run(build / "detect", *camera, dummy_server.grpc_address)
    assert done.stdout.count("score 0.") == 5, done.stderr
    wrong = run(build / "detect", depth, 99, *camera[2:], dummy_server.grpc_address, code=1)
    assert "error 3: depth_images.0" in wrong.stderr


def test_region_on_a_handle(real_server) -> None:
    shown = example("region_on_a_handle.py", real_server.grpc_address)
    contacts = re.findall(r"contact point at (\S+), (\S+), (\S+) m", shown)
    assert len(contacts) == 5
    apart = np.array(contacts, dtype=float) - (0.122, 0.098, 0.497)
    assert np.linalg.norm(apart, axis=1).max() < 0.023


def test_your_gripper(real_server) -> None:
    small, panda = example("your_gripper.py", real_server.grpc_address).split("panda:")
    openings = [int(text) for text in re.findall(r"opening (\d+) mm", small)]
    assert len(openings) == panda.count("score") == 5
    assert max(openings) <= 50


def test_depth_camera(tmp_path: Path) -> None:
    example("depth_camera.py", tmp_path)
    with Image.open(tmp_path / "depth.png") as depth, Image.open(tmp_path / "color.png") as color:
        assert depth.mode == "I;16"
        assert depth.size == color.size == (640, 480)
        assert (np.asarray(depth) > 0).mean() > 0.5


def test_follow_an_object(real_server) -> None:
    shown = example("follow_an_object.py", real_server.grpc_address)
    found = re.findall(r"^(\d+) score (0\.\d+) \[ ?(\S+) ", shown, re.MULTILINE)
    identities, _, along = np.array(found, dtype=float).T
    assert np.mean(identities == identities[0]) > 0.5
    assert along[identities == identities[0]].max() - along[0] > 0.01


def test_several_views(real_server) -> None:
    pattern = r"each view: \[(.*)\] grasps, best holds \[.*\]; all three: (\d+), True"
    printed = re.findall(pattern, example("several_views.py", real_server.grpc_address, "2"))
    for alone, together in printed:
        assert int(together) >= max(map(int, alone.split(", ")))
    assert len(printed) == 2


def test_pick_and_place(real_server) -> None:
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    pytest.importorskip("roboplan", reason="the extra robot is not installed")
    shown = example("pick_and_place.py", real_server.grpc_address)
    inside = re.search(r"(\d) of 3 objects in the tray", shown)
    assert inside is not None
    assert int(inside[1]) >= 2


def test_your_planner(tmp_path: Path) -> None:
    asked = ("benchmark", "--planner", "your_planner:plan", "--scene", "packed", "--rounds", "2")
    flags = ("--seed", "0", "--workers", "1", "--no-report", "--output", tmp_path / "out")
    for absent in ("orjson", "torch"):  # it needs the extra `sim` alone
        (tmp_path / f"{absent}.py").write_text(f"raise ModuleNotFoundError(name={absent!r})")
    paths = os.pathsep.join([str(tmp_path), *sys.path, str(EXAMPLES)])
    done = run(*EDGEGRASP, *asked, *flags, env=os.environ | {"PYTHONPATH": paths})
    assert "your_planner:plan: GSR" in done.stdout
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["attempts"] > 0


def test_training_on_your_objects(tmp_path: Path) -> None:
    for split in ("train", "test"):
        folder = tmp_path / "objects" / "packed" / split
        folder.mkdir(parents=True)
        (folder / "block.obj").write_text(block_obj(5, 4, 9))
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    words = (tmp_path / "objects", tmp_path / "out", 2, 1)
    environment = os.environ | {"PATH": programs}
    # On one processor no command starts further processes, which take longer than two scenes.
    alone = partial(os.sched_setaffinity, 0, {min(os.sched_getaffinity(0))})
    script = EXAMPLES / "train_on_your_objects.sh"
    done = run("bash", script, *words, env=environment, preexec_fn=alone)
    assert (tmp_path / "out" / "run" / "edgegrasp-plus.safetensors").is_file()
    assert "GSR" in done.stdout


def test_without_a_server() -> None:
    assert example("without_a_server.py").count("score 0.") == 5
