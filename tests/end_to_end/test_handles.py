"""Grasp the handle: both regions restricted to it, with the weights that ship, in simulation."""

import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from edgegrasp_model.detector import WEIGHTS_FOLDER, GraspDetector, ModelCatalogue
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.camera import CAMERA, look_at
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement

TABLE = 0.05  # height, metres
Bar = tuple[tuple[float, float, float], tuple[float, float, float], float]  # middle, size, yaw


@dataclass(frozen=True)
class Tool:
    name: str
    body: list[Bar]
    handle: list[Bar]
    height: float  # of the origin over the table, metres
    region: tuple[tuple[float, float, float], tuple[float, float, float]]  # middle, half extents

    def write(self, folder: Path) -> Path:
        parts = "".join(
            f'<{kind}><origin xyz="{x} {y} {z}" rpy="0 0 {yaw}"/>'
            f'<geometry><box size="{a} {b} {c}"/></geometry></{kind}>'
            for (x, y, z), (a, b, c), yaw in self.body + self.handle
            for kind in ("visual", "collision")
        )
        inertia = '<mass value="0.3"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" '
        path = folder / f"{self.name}.urdf"
        path.write_text(
            f'<robot name="{self.name}"><link name="base"><inertial>{inertia}izz="1e-4"/>'
            f"</inertial>{parts}</link></robot>"
        )
        return path


def mug() -> Tool:
    """A cup of 16 staves with a bottom, and a handle of three bars."""
    staves: list[Bar] = []
    for angle in np.arange(16) * np.pi / 8:
        x, y = 0.033 * np.cos(angle), 0.033 * np.sin(angle)
        staves.append(((x, y, 0.0), (0.005, 0.0145, 0.08), float(angle)))
    bottom: Bar = ((0, 0, -0.038), (0.045, 0.045, 0.004), 0.0)
    handle: list[Bar] = [
        ((0.049, 0, 0.022), (0.03, 0.012, 0.008), 0.0),
        ((0.049, 0, -0.022), (0.03, 0.012, 0.008), 0.0),
        ((0.064, 0, 0), (0.008, 0.012, 0.052), 0.0),
    ]
    return Tool("mug", [*staves, bottom], handle, 0.04, ((0.055, 0, 0), (0.016, 0.012, 0.03)))


def hammer() -> Tool:
    """A head on a shaft, lying on the table; the shaft's end props it up level."""
    head: Bar = ((0.06, 0, 0), (0.03, 0.09, 0.03), 0.0)
    foot: Bar = ((-0.085, 0, 0), (0.012, 0.02, 0.03), 0.0)
    shaft: Bar = ((-0.02, 0, 0.004), (0.13, 0.02, 0.022), 0.0)
    return Tool("hammer", [head, foot], [shaft], 0.015, ((-0.02, 0, 0.005), (0.055, 0.016, 0.016)))


@pytest.fixture(scope="module")
def shipped() -> GraspDetector:
    if not any(WEIGHTS_FOLDER.glob("*.safetensors")):
        pytest.skip("no weights ship with this checkout")
    return ModelCatalogue.load().get()


@pytest.mark.parametrize(("tool", "yaw"), [(mug(), 0.7), (hammer(), 0.0)], ids=["mug", "hammer"])
def test_restricted_to_the_handle_every_grasp_is_on_it_and_the_best_holds(
    tool: Tool, yaw: float, shipped: GraspDetector, tmp_path: Path
) -> None:
    turn, middle = Rotation.from_euler("z", yaw), np.array([0.14, 0.14, TABLE + tool.height])
    x, y, z, w = turn.as_quat().tolist()
    with ClutterSimulation() as simulation:
        simulation.reset_from_poses(
            [ObjectPlacement(tool.write(tmp_path), 1.0, tuple(middle.tolist()), (x, y, z, w))]
        )
        eye = np.array([0.55, 0.35, 0.55])
        noise = np.random.default_rng(3)
        camera = look_at(eye, np.array([0.15, 0.15, 0.06]))
        seen = simulation.observe_from([camera], noise)
        center, half = tool.region
        region = {
            "include": [
                {
                    "kind": "oriented_box",
                    "center": (turn.apply(center) + middle).tolist(),
                    "half_extents": half,
                    "quaternion": (x, y, z, w),
                }
            ]
        }
        asked = {
            "viewpoint": seen.camera_position.tolist(),
            "support": {"normal": (0, 0, 1), "offset": TABLE},
            "num_approach_points": 48,
        }
        free = shipped.detect(seen.cloud, DetectOptions.model_validate(asked))
        found = shipped.detect(
            seen.cloud,
            DetectOptions.model_validate(
                asked | {"approach_region": region, "contact_region": region}
            ),
        )
        assert len(found.grasps) >= 3
        for grasp in found.grasps:
            for point in (grasp.approach_point, grasp.contact_point):
                own = turn.inv().apply(point - middle) - center
                assert (np.abs(own) <= half).all()
        # Without the restriction grasps lie elsewhere too: the test can fail.
        elsewhere = [
            turn.inv().apply(grasp.contact_point - middle) - center for grasp in free.grasps
        ]
        assert any((np.abs(own) > half).any() for own in elsewhere)
        assert simulation.try_grasp(found.grasps[0].T_cloud_hand).success


def test_the_examples_grasp_what_was_marked(start_server, shipped, tmp_path: Path) -> None:
    tool, middle = mug(), np.array([0.14, 0.14, TABLE + 0.04])
    with ClutterSimulation() as simulation:
        placed = ObjectPlacement(tool.write(tmp_path), 1.0, tuple(middle.tolist()), (0, 0, 0, 1))
        simulation.reset_from_poses([placed])
        camera = look_at(np.array([0.55, 0.35, 0.55]), np.array([0.15, 0.15, 0.06]))
        depth = simulation.world.render_depth(camera, CAMERA)
    seen = depth < 0.95 * CAMERA.far
    np.save(tmp_path / "depth.npy", np.where(seen, depth, np.nan).astype(np.float32))
    focal, centre = CAMERA.focal_length, (CAMERA.centre_x, CAMERA.centre_y - 1.0)
    rows, columns = np.indices(depth.shape)
    x, y = (columns - centre[0]) / focal * depth, (rows - centre[1]) / focal * depth
    points = np.stack([x, y, depth], axis=-1)
    center, half = tool.region
    own = points @ camera[:3, :3].T + camera[:3, 3] - middle - center
    handle = seen & (np.abs(own) <= half).all(axis=-1)
    assert handle.sum() > 100
    Image.fromarray(handle.astype(np.uint8) * 255).save(tmp_path / "handle.png")
    np.save(tmp_path / "handle.npy", points[handle])
    np.save(tmp_path / "scene.npy", points[seen])

    examples = Path(__file__).parents[2] / "examples"
    intrinsics = ",".join(str(number) for number in (focal, focal, *centre))
    files = {
        "12_handle_of_the_red_mug.py": ["depth.npy", "handle.png", intrinsics],
        "13_object_and_scene.py": ["handle.npy", "scene.npy"],
    }
    with start_server("--log-level", "warning") as server:
        for example, words in files.items():
            command = [sys.executable, examples / example, *words, server.grpc_address]
            done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
            contacts = re.findall(r"contact at (\S+), (\S+), (\S+) m", done.stdout)
            assert len(contacts) == 5, done.stdout + done.stderr
            for contact in np.array(contacts, float):
                in_region = camera[:3, :3] @ contact + camera[:3, 3] - middle - center
                assert (np.abs(in_region) <= np.array(half) + 0.005).all()
