"""Grasp the handle: both regions restricted to it, with the weights that ship, in simulation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgegrasp_client import GraspClient, object_in_scene, on_mask
from edgegrasp_model.detector import GraspDetector, ModelCatalogue
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


def test_grasps_are_on_what_a_mask_or_the_cloud_of_an_object_marks(real_server, tmp_path) -> None:
    tool, middle = mug(), np.array([0.14, 0.14, TABLE + 0.04])
    with ClutterSimulation() as simulation:
        placed = ObjectPlacement(tool.write(tmp_path), 1.0, tuple(middle.tolist()), (0, 0, 0, 1))
        simulation.reset_from_poses([placed])
        camera = look_at(np.array([0.55, 0.35, 0.55]), np.array([0.15, 0.15, 0.06]))
        depth = simulation.world.render_depth(camera, CAMERA)
    seen = depth < 0.95 * CAMERA.far
    focal, x0, y0 = CAMERA.focal_length, CAMERA.centre_x, CAMERA.centre_y - 1.0
    rows, columns = np.indices(depth.shape)
    points = np.stack([(columns - x0) / focal * depth, (rows - y0) / focal * depth, depth], axis=-1)
    center, half = np.array(tool.region)

    def in_region(places: np.ndarray) -> np.ndarray:
        return places @ camera[:3, :3].T + camera[:3, 3] - middle - center

    handle = seen & (np.abs(in_region(points)) <= half).all(axis=-1)
    assert handle.sum() > 100
    depths = np.where(seen, depth, np.nan).astype(np.float32)
    image = {"depth": depths, "intrinsics": (focal, focal, x0, y0)}
    cloud, segment_ids = object_in_scene(points[handle], points[seen])
    with GraspClient(real_server.grpc_address) as client:
        by_mask = client.detect(depth_images=[image], **on_mask(handle, {"top_k": 5}))
        by_object = client.detect(cloud, segment_ids=segment_ids, viewpoint=(0, 0, 0), top_k=5)
    for found in (by_mask, by_object):
        contacts = np.array([grasp.contact_point for grasp in found.grasps])
        assert len(contacts) == 5
        assert (np.abs(in_region(contacts)) <= half + 0.005).all()
