"""The pages name what there is."""

import re
from pathlib import Path

import numpy as np

from edgegrasp_cli.flags import TOKEN_VARIABLE
from edgegrasp_client import conversions
from edgegrasp_service.settings import Settings

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def test_files_and_folders_that_pages_link_to_exist() -> None:
    for page in (ROOT / "README.md", *DOCS.glob("*.md")):
        for name in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", page.read_text()):
            assert (page.parent / name).exists(), f"{page.name}: {name}"
    readme = (ROOT / "README.md").read_text()
    folders = re.findall(r"^\| `([a-z_/0-9]+/[a-z_/0-9]*)` \|", readme, flags=re.MULTILINE)
    assert len(folders) >= 5
    assert [name for name in folders if not (ROOT / name).exists()] == []


def test_variables_that_the_pages_name_exist() -> None:
    known = {f"EDGEGRASP_{name.upper()}" for name in Settings.model_fields}
    beside = [ROOT / name for name in ("README.md", "Dockerfile", "docker/compose.yaml")]
    for page in (*DOCS.glob("*.md"), *beside):
        named = set(re.findall(r"\bEDGEGRASP_[A-Z_]+", page.read_text()))
        assert named <= {*known, "EDGEGRASP_CONFIG", TOKEN_VARIABLE, "EDGEGRASP_"}, page.name


def test_the_requests_of_cameras_can_be_made(dummy_server) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "cameras.md").read_text(), flags=re.DOTALL)
    depth = np.random.default_rng(0).integers(500, 600, (24, 32)).astype(np.uint16)
    given = {"depth": depth, "intrinsics": (60.0, 60.0, 15.5, 11.5), "depth_scale": 0.001}
    given |= {"mask": depth > 550, "points": depth[..., None] * np.full(3, 0.001)}
    requests = [block for block in blocks if "GraspClient(" in block]
    assert len(requests) >= 4
    for block in blocks:
        code = compile(block.replace("127.0.0.1:50051", dummy_server.grpc_address), block, "exec")
        if block in requests:
            names = {"T_base_camera": np.eye(4), **given}
            exec(code, names)
            assert names["detection"].grasps


def test_the_example_of_conversions_names_what_there_is() -> None:
    frames = (DOCS / "frames.md").read_text()
    imported = re.search(r"conversions import \(\n(.*?)\n\)", frames, flags=re.DOTALL)
    assert imported is not None
    assert all(hasattr(conversions, name) for name in re.findall(r"\w+", imported[1]))
