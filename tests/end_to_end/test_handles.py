"""Grasp the handle: regions restrict both points, and what is grasped there holds."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pybullet_data
import pytest

from edgegrasp_model.catalogue import ModelCatalogue
from edgegrasp_model.cloud_input import CloudInput
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.camera import look_at
from edgegrasp_sim.scene import TABLE_HEIGHT
from edgegrasp_sim.simulation import ClutterSimulation, ObjectPlacement, Observation

HAMMER = """
<robot name="hammer"><link name="base_link">
  <inertial><mass value="0.4"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  {parts}
</link></robot>
"""
HANDLE = '<origin xyz="0 0 0"/><geometry><box size="0.16 0.022 0.022"/></geometry>'
HEAD = '<origin xyz="0.09 0 0"/><geometry><box size="0.03 0.09 0.03"/></geometry>'


class Case(NamedTuple):
    placement: ObjectPlacement
    low: tuple[float, float, float]  # of the handle, world frame, metres
    high: tuple[float, float, float]
    eye: tuple[float, float, float]


def hammer(folder: Path) -> Case:
    parts = "".join(
        f"<{use}>{shape}</{use}>" for shape in (HANDLE, HEAD) for use in ("visual", "collision")
    )
    urdf = folder / "hammer.urdf"
    urdf.write_text(HAMMER.format(parts=parts))
    middle = (0.14, 0.15, TABLE_HEIGHT + 0.0155)
    placement = ObjectPlacement(urdf, 1.0, middle, (0.0, 0.0, 0.0, 1.0))
    return Case(placement, (0.05, 0.13, 0.05), (0.205, 0.17, 0.09), (0.15, 0.65, 0.6))


def mug(folder: Path) -> Case:
    urdf = Path(pybullet_data.getDataPath()) / "objects" / "mug.urdf"
    placement = ObjectPlacement(urdf, 0.8, (0.15, 0.12, TABLE_HEIGHT), (0.0, 0.0, 0.0, 1.0))
    # Scaled, the handle spans y 0.034 to 0.065 from the axis.
    return Case(placement, (0.13, 0.156, 0.05), (0.17, 0.19, 0.14), (0.55, 0.4, 0.5))


def on_handle(points: np.ndarray, case: Case) -> np.ndarray:
    return ((points >= case.low) & (points <= case.high)).all(axis=-1)


def ask(seen: Observation, region: dict[str, object]) -> DetectOptions:
    return DetectOptions.model_validate(
        {
            "viewpoint": seen.camera_position.tolist(),
            "support": {"normal": (0, 0, 1), "offset": TABLE_HEIGHT},
            "approach_region": region,
            "contact_region": region,
            "seed": 1,
        }
    )


@pytest.mark.parametrize("make", [hammer, mug])
def test_grasps_stay_on_the_handle_and_the_best_one_holds(make, tmp_path: Path) -> None:
    case = make(tmp_path)
    detector = ModelCatalogue.load().get()
    box = {"kind": "box", "min": case.low, "max": case.high}
    with ClutterSimulation() as simulation:
        simulation.reset_from_poses([case.placement])
        camera = look_at(np.array(case.eye), np.array(case.placement.position))
        seen = simulation.observe_from([camera], np.random.default_rng(0))

        anywhere = detector.detect(seen.cloud, ask(seen, {"exclude": []}))
        points = np.array([[g.approach_point, g.contact_point] for g in anywhere.grasps])
        assert not on_handle(points, case).all()

        found = detector.detect(seen.cloud, ask(seen, {"include": [box]}))
        points = np.array([[g.approach_point, g.contact_point] for g in found.grasps])
        assert len(points) >= 3
        assert on_handle(points, case).all()

        segment_ids = on_handle(seen.cloud, case).astype(np.int32)
        by_segment = {"include": [{"kind": "segments", "ids": [1]}]}
        cloud = CloudInput(seen.cloud, segment_ids=segment_ids)
        named = detector.detect(cloud, ask(seen, by_segment))
        points = np.array([[g.approach_point, g.contact_point] for g in named.grasps])
        assert len(points) >= 3
        assert on_handle(points, case).all()

        assert simulation.try_grasp(found.grasps[0].T_cloud_hand).success
        assert simulation.try_grasp(named.grasps[0].T_cloud_hand).success
