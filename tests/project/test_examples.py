"""The examples run as their first lines say."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def cloud_file(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    path = tmp_path / "cloud.ply"
    rows = "\n".join(f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in rng.uniform(0.0, 0.2, (500, 3)))
    header = "ply\nformat ascii 1.0\nelement vertex 500\n"
    columns = "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_text(header + columns + rows + "\n")
    return path


def run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def test_demo_prints_ranked_grasps_of_both_transports_and_writes_a_picture(tmp_path: Path) -> None:
    done = run(sys.executable, EXAMPLES / "demo.py", "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    grpc_table, rest_table = re.split(r"\n\d+ grasps over ", done.stdout)[1:]
    ranked = re.compile(r"^ +(\d+)  (0\.\d+)  ", re.MULTILINE)
    assert len(ranked.findall(grpc_table)) >= 10
    assert ranked.findall(grpc_table) == ranked.findall(rest_table)
    assert "the same grasps" in done.stdout
    assert re.search(
        r"Executed the best one in the simulator: it (held|did not hold)\.", rest_table
    )
    assert (tmp_path / "grasps.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "scene.ply").read_bytes().startswith(b"ply\n")


def test_python_example_prints_five_grasps(dummy_server, cloud_file: Path) -> None:
    example = EXAMPLES / "01_detect_from_python.py"
    over_grpc = run(sys.executable, example, cloud_file, dummy_server.grpc_address)
    over_rest = run(sys.executable, example, cloud_file, dummy_server.http_url)
    assert over_grpc.stdout.count("score 0.") == 5, over_grpc.stderr
    assert over_grpc.stdout.partition("counts")[0] == over_rest.stdout.partition("counts")[0]


def test_stream_example_prints_a_grasp_of_each_cloud_and_goes_on(dummy_server, cloud_file) -> None:
    empty = cloud_file.with_name("empty.npy")
    np.save(empty, np.zeros((0, 3), np.float32))
    names = [str(cloud_file), str(empty), str(cloud_file)]
    for address in (dummy_server.grpc_address, dummy_server.http_url):
        done = run(sys.executable, EXAMPLES / "04_stream_of_clouds.py", *names, "--server", address)
        first, second, third = done.stdout.splitlines()
        assert first == third
        assert first.startswith(f"{cloud_file}: score 0.")
        assert second.startswith(f"{empty}: cloud: got ")


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_curl_example_prints_five_grasps(dummy_server, cloud_file: Path) -> None:
    done = run("bash", EXAMPLES / "02_detect_over_rest.sh", cloud_file, dummy_server.http_url)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["grasps"]) == 5


def test_cpp_example_is_built_and_prints_five_grasps(dummy_server, tmp_path: Path) -> None:
    for program in ("cmake", "c++", "protoc", "grpc_cpp_plugin", "pkg-config"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed, see examples/cpp/CMakeLists.txt")
    if run("pkg-config", "--exists", "grpc++").returncode:
        pytest.skip("gRPC for C++ is not installed, see examples/cpp/CMakeLists.txt")
    build = tmp_path / "build"
    made = run("cmake", "-S", EXAMPLES / "cpp", "-B", build)
    made = made if made.returncode else run("cmake", "--build", build, "--parallel", 2)
    assert made.returncode == 0, made.stdout + made.stderr
    depth = tmp_path / "depth.raw"
    depth.write_bytes(np.full((48, 64), 600, "<u2").tobytes())
    camera = (depth, 64, 48, 60, 60, 32, 24)
    done = run(build / "detect", *camera, dummy_server.grpc_address)
    assert done.stdout.count("score 0.") == 5, done.stderr
    wrong = run(build / "detect", depth, 99, *camera[2:], dummy_server.grpc_address)
    assert wrong.returncode == 1
    assert wrong.stderr.startswith("error 3: depth_images.0")
