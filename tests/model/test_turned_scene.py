"""Nothing is assumed of the cloud's frame: a turned scene has the same grasps, turned."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.cloud import CloudInput

from .scenes import box_on_table, detector

VIEW = np.array([0.4, 0.15, 0.45])


class Turned:
    """A rigid motion of a scene and of everything a request says about it."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.turn = Rotation.random(rng=rng)
        self.shift = rng.uniform(-0.4, 0.4, 3)

    def points(self, points: np.ndarray) -> np.ndarray:
        return self.turn.apply(np.asarray(points, np.float64)) + self.shift

    def point(self, *xyz: float) -> list[float]:
        return self.points(np.array([xyz]))[0].tolist()

    def direction(self, *xyz: float) -> list[float]:
        return self.turn.apply(np.array(xyz)).tolist()

    def plane(self, normal: list[float], offset: float) -> dict[str, object]:
        turned = self.turn.apply(normal)
        return {"normal": turned.tolist(), "offset": offset + float(turned @ self.shift)}


def constraints(turned: Turned) -> dict[str, object]:
    """Every kind of constraint that is not bound to the frame's axes."""
    box = {
        "kind": "oriented_box",
        "center": turned.point(0.0, 0.0, 0.05),
        "half_extents": [0.05, 0.05, 0.045],
        "quaternion": turned.turn.as_quat().tolist(),
    }
    hole = {"kind": "sphere", "center": turned.point(0.02, 0.0, 0.08), "radius": 0.01}
    far = {"kind": "half_space", **turned.plane([0.0, 1.0, 0.0], -0.02)}
    wall = {**box, "center": turned.point(-0.2, 0.0, 0.1), "half_extents": [0.02, 0.2, 0.1]}
    return {
        "viewpoint": turned.point(*VIEW),
        "up": turned.direction(0.0, 0.0, 2.0),
        "support": turned.plane([0.0, 0.0, 1.0], 0.0),
        "approach_region": {"include": [box], "exclude": [hole]},
        "contact_region": {"include": [far]},
        "approach_direction": {
            "cones": [{"direction": turned.direction(-0.2, 0.1, -1.0), "max_angle": 0.9}],
            "preset": "top-down",
        },
        "collision": {
            "obstacles": [wall],
            "margin": 0.001,
            "retreat_length": 0.06,
            "retreat_direction": "up",
        },
        "num_approach_points": 16,
    }


def frame_only(turned: Turned) -> dict[str, object]:
    return {"up": turned.direction(0.0, 0.0, 1.0), "num_approach_points": 16}


def found_plane(turned: Turned) -> dict[str, object]:
    return {
        "viewpoint": turned.point(*VIEW),
        "up": turned.direction(0.0, 0.0, 1.0),
        "support": {"kind": "ransac"},
        "order": "highest",
        "num_approach_points": 16,
    }


@pytest.mark.parametrize("request_of", [constraints, frame_only, found_plane])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_turned_scene_has_the_same_grasps_turned(request_of, seed) -> None:
    still, turned = Turned(0), Turned(seed)
    still.turn, still.shift = Rotation.identity(), np.zeros(3)
    cloud = box_on_table(4000, table=request_of is found_plane)
    here = detector().detect(
        CloudInput(cloud.astype(np.float64)), DetectOptions.model_validate(request_of(still))
    )
    there = detector().detect(
        CloudInput(turned.points(cloud)), DetectOptions.model_validate(request_of(turned))
    )
    assert len(here.grasps) >= 5
    for name, count in here.counts.items():  # a point on a border may fall on either side
        assert abs(there.counts[name] - count) <= 1 + 0.02 * count, name
    contacts = np.array([grasp.contact_point for grasp in there.grasps])
    for a in here.grasps[:5]:
        apart = np.linalg.norm(contacts - turned.points(a.contact_point), axis=1)
        same = [there.grasps[row] for row in np.flatnonzero(apart < 5e-4)]
        rotation = turned.turn.as_matrix() @ a.T_cloud_hand[:3, :3]
        assert any(
            np.allclose(b.T_cloud_hand[:3, :3], rotation, atol=5e-3)
            and np.allclose(b.T_cloud_tcp[:3, 3], turned.points(a.T_cloud_tcp[:3, 3]), atol=1e-3)
            and abs(b.score - a.score) < 0.02
            and abs(b.clearance - a.clearance) < 1e-3
            and abs(b.width - a.width) < 1e-3
            for b in same
        )
