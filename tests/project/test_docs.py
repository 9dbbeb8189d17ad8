"""The pages name what there is, their blocks run, and they make a site that needs no network."""

import contextlib
import hashlib
import importlib.util
import io
import json
import os
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image
from tests.cloud_files import ply
from tests.programs import EDGEGRASP, ROOT, run

from edgegrasp_cli.flags import TOKEN_VARIABLE
from edgegrasp_cli.main import load_command
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_model.options import DetectOptions
from edgegrasp_service.errors import STATUS, kind_of
from edgegrasp_service.settings import Settings

DOCS = ROOT / "docs"
PAGES = {page.name: page.read_text() for page in (*DOCS.glob("*.md"), *ROOT.glob("*.md"))}
ALL_DOCS = "\n".join(PAGES[page.name] for page in DOCS.glob("*.md"))

# Python that is compiled only: cameras that no machine has, a cluster, a server with TLS, an arm
# and images of a camera (tests elsewhere have these).
ABSENT = {"pyrealsense2", "pyk4a", "pyorbbecsdk", "zivid", "harvesters", "ray"}
COMPILED = ("Tls(", *(f"import {name}" for name in ABSENT), *(f"from {name}" for name in ABSENT))
ELSEWHERE = {"robots.md", "tracking.md"}
# Commands of other programs, which change the machine or need what it has not.
OTHERS = {".", "apt-get", "cd", "colcon", "docker", "git", "ln", "openssl", "pip", "ray", "rosdep"}
OTHERS |= {"python3", "ros2", "serve"}


def blocks(language: str) -> Iterator[tuple[str, str]]:
    """The name of the page and the text of each block in a language."""
    for name, text in PAGES.items():
        for found in re.finditer(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            if found[1] == language:
                yield name, found[2]


def commands() -> Iterator[tuple[str, list[str]]]:
    """The name of the page and the words of each command that it shows."""
    for name, block in blocks("console"):
        for line in re.findall(r"^[$#] ((?:.*\\\n)*.*)$", block, re.MULTILINE):
            shown = re.sub(r"\s#.*", "", line.replace("\\\n", " "))
            for command in re.split(r"&&|;", shown):
                words = shlex.split(command)
                while words and re.match(r"[A-Z_]+=", words[0]):
                    words.pop(0)
                yield name, words


def test_files_and_variables_that_the_pages_name_exist() -> None:
    for page in (*ROOT.glob("*.md"), *DOCS.glob("*.md")):
        for name in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text()):
            assert (page.parent / name).exists(), f"{page.name}: {name}"
    known = {f"EDGEGRASP_{name.upper()}" for name in Settings.model_fields}
    beside = [(ROOT / name).read_text() for name in ("Dockerfile", "docker/compose.yaml")]
    for text in (*PAGES.values(), *beside):
        named = set(re.findall(r"\bEDGEGRASP_[A-Z_]+", text))
        assert named <= {*known, "EDGEGRASP_CONFIG", TOKEN_VARIABLE, "EDGEGRASP_"}


def test_every_option_setting_error_and_metric_is_in_a_page(dummy_server) -> None:
    served = httpx.get(f"{dummy_server.http_url}/metrics").text
    metrics = set(re.findall(r"^# TYPE (edgegrasp_\w+)", served, re.MULTILINE))
    metrics = {name for name in metrics if not name.endswith("_created")}
    assert len(metrics) > 10
    kinds = {kind_of(error) for error in STATUS}
    wanted = kinds | metrics | set(Settings.model_fields) | set(DetectOptions.model_fields)
    assert [name for name in sorted(wanted) if f"`{name}`" not in ALL_DOCS] == []


def test_tables_that_a_script_writes_are_up_to_date() -> None:
    written = runpy.run_path(str(DOCS / "make_tables.py"))["pages"]()
    assert [page.name for page, text in written.items() if page.read_text() != text] == []


def test_the_python_of_the_pages_runs(start_dummy, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    pytest.importorskip("yaml", reason="the extra `yaml` is not installed")
    write_what_commands_read(tmp_path)
    depth = np.random.default_rng(0).integers(500, 600, (24, 32)).astype(np.uint16)
    points = depth[..., None] * np.full(3, 0.001, np.float32)
    np.save("scene.npy", points.reshape(-1, 3))
    Image.fromarray(depth).save("depth.png")
    given = {"depth": depth, "depth_scale": 0.001, "intrinsics": (60.0, 60.0, 15.5, 11.5)}
    given |= {"points": points, "mask": depth > 550, "T_base_camera": np.eye(4)}
    given |= {"camera": lambda: [points.reshape(-1, 3)], "use": print}
    addresses = r"127\.0\.0\.1:50051|unix:/run/edgegrasp/grpc\.sock"
    ran = 0
    with start_dummy("--outcomes-file", "outcomes.jsonl") as server:
        names = {name: dict(given) for name in PAGES}
        for name, block in blocks("python"):
            code = re.sub(addresses, server.grpc_address, block)
            code = code.replace("http://127.0.0.1:8000", server.http_url)
            code = code.replace("(615, 615, 320, 240)", "(60, 60, 15.5, 11.5)")
            compiled = compile(code, f"{name}: {code}", "exec")
            if name in ELSEWHERE or any(text in block for text in COMPILED):
                continue
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compiled, names[name])
            ran += 1
    assert ran >= 9
    assert Path("outcomes.jsonl").read_text().count("\n") == 1


def test_the_commands_of_the_pages_exist_and_have_their_flags(monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    seen = set()
    for page, words in commands():
        program = words[0]
        seen.add(program)
        shown = f"{page}: {' '.join(words)}"
        if program == "edgegrasp":
            command = load_command(words[1])
            if hasattr(command, "commands") and words[2] in command.commands:
                command = command.commands[words[2]]
            flags = {flag for each in command.params for flag in (*each.opts, *each.secondary_opts)}
            used = {word.partition("=")[0] for word in words if word.startswith("--")}
            assert used - {"--help"} <= flags, shown
        elif program == "make":
            asked = [word for word in words[1:] if "=" not in word]
            assert set(asked) <= set(targets), shown
        elif program in ("python", ".venv/bin/python"):
            module = words[1] == "-m"
            here = importlib.util.find_spec(words[2]) if module else (ROOT / words[1]).exists()
            assert here, shown
        else:
            assert program in OTHERS | {"curl"}, shown
    assert {"edgegrasp", "make", "python", "curl"} <= seen


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_requests_by_curl_are_answered(dummy_server, tmp_path: Path) -> None:
    write_what_commands_read(tmp_path)
    Image.fromarray(np.full((480, 640), 600, np.uint16)).save(tmp_path / "depth.png")
    (tmp_path / "tokens").write_text("0123456789abcdef")
    lines = {
        line
        for _, block in blocks("console")
        for line in re.findall(r"^\$ (curl (?:.*\\\n)*.*)$", block, re.MULTILINE)
    }
    assert len(lines) >= 3
    for line in lines:
        asked = re.sub(r"--unix-socket \S+ http://localhost", dummy_server.http_url, line)
        asked = asked.replace("http://127.0.0.1:8000", dummy_server.http_url)
        said = run("bash", "-c", asked, cwd=tmp_path).stdout
        assert {"grasps", "models"} & json.loads(said).keys(), line + said


def write_what_commands_read(folder: Path) -> None:
    """The files of a checkout in which `make demo` was run, as far as the pages name them."""
    (folder / "examples").symlink_to(ROOT / "examples")
    (folder / "demo_output").mkdir()
    x, y = np.divmod(np.arange(400), 20)
    level = np.stack([x, y, np.full(400, 0.5)], axis=1)
    (folder / "demo_output" / "scene.ply").write_bytes(ply(level))


def test_the_commands_of_the_start_pages_run_as_they_stand(tmp_path: Path) -> None:
    write_what_commands_read(tmp_path)
    detected = set()
    for page, words in commands():
        shown = " ".join(words)
        if page not in ("README.md", "index.md") or shown in detected:
            continue
        assert not re.search(r"\b[A-Z_]{4,}\b|~/", shown), f"{page}: {shown} has a placeholder"
        for file in re.findall(r"(?<!picture )(?<![\w/])[\w/]+\.(?:png|ply|npz|npy)", shown):
            assert (tmp_path / file).exists(), f"{page}: nobody has {file}"
        if words[:2] == ["edgegrasp", "detect"]:
            run(sys.executable, "-P", *EDGEGRASP[1:], *words[1:], cwd=tmp_path)
            with Image.open(tmp_path / words[words.index("--picture") + 1]) as picture:
                assert min(picture.size) > 300
            detected.add(shown)
    assert detected


def test_every_table_of_results_is_of_the_weights_that_ship() -> None:
    files = {path.stem: path for path in WEIGHTS_FOLDER.glob("*.safetensors")}
    files["scene"] = WEIGHTS_FOLDER.parent / "scene" / "network.safetensors"
    shipped = {n: hashlib.sha256(file.read_bytes()).hexdigest()[:8] for n, file in files.items()}
    tables = re.findall(r"(?:^\|.*\n)+(?:(?!\||#).*\n)*", PAGES["results.md"], re.MULTILINE)
    lines = [re.search(r"^Weights: (.*)$", table, re.MULTILINE) for table in tables]
    assert lines.count(None) == 1  # the figures of others
    for line in (found[1] for found in lines if found):
        for name, digest in re.findall(r"([\w-]+) `(\w{8})`", line):
            assert shipped[name] == digest


def test_the_site_is_built_without_a_warning_and_asks_nobody(tmp_path: Path) -> None:
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    build = (sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site")
    run(*build, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 15
    loaded = r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=\"?(?:https?:)?//[^>]*>"
    assert [found for page in pages for found in re.findall(loaded, page.read_text())] == []
