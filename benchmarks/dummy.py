"""A detector of known service time and made-up grasps, to measure and test the service alone."""

import os
import time
import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np

from edgegrasp_camera.arrays import Array, Float32
from edgegrasp_model.errors import UnknownModel
from edgegrasp_model.given import check_edges, check_hand_poses
from edgegrasp_model.gripper import choose_gripper, load_gripper
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import NoGraspReason, Outcome, UnitCosts
from edgegrasp_model.scene.cloud import CloudInput, check_cloud
from edgegrasp_results import DebugInfo, Detection, Evaluation, Grasp, GripperOutline, Scoring

NAME = "dummy"
TCP_Z = 0.1  # metres along the hand's z
DOWN = np.array([0.0, 0.0, -1.0], np.float32)
PANDA = load_gripper("panda")
APPROACH_POINTS = 32  # if a request does not set a number
GRASPS = 10  # made at most
WARNING = "The dummy detector made these grasps up."
SECONDS = float(os.environ.get("DUMMY_SECONDS", "0"))  # of service time


class DummyDetector:
    """Makes top-down grasps on points drawn from the seed; its network takes SECONDS."""

    def prepare(self, cloud: CloudInput, options: DetectOptions, *_: int) -> SimpleNamespace:
        """Draw approach points, the same for the same cloud and options."""
        points = check_cloud(cloud, options.num_approach_points or 1).points
        random = np.random.default_rng(options.seed)
        wanted = options.num_approach_points or min(APPROACH_POINTS, len(points))
        drawn = random.choice(len(points), wanted, replace=False)
        scores = np.sort(random.random(len(drawn), dtype=np.float32))[::-1]
        crc32 = zlib.crc32(points.tobytes())  # a caller can check that the answer is for its cloud
        counts = {"points": len(points), "scored": len(drawn), "crc32": crc32}
        # `drawn`: (A,) approach points, rows of `points` (N, 3); `batch`: (A,) descending scores,
        # which the network returns.
        stages: dict[str, Any] = {"counts": counts, "seconds": {}, "scene": None}
        return SimpleNamespace(options=options, points=points, drawn=drawn, batch=scores, **stages)

    def evaluate(self, prepared: SimpleNamespace) -> Float32:
        """Wait as long as a network would take."""
        time.sleep(SECONDS)
        prepared.seconds["network"] = SECONDS
        return prepared.batch

    def finish(self, prepared: SimpleNamespace, logits: Float32) -> Detection:
        """Put a grasp on each of the best approach points."""
        options, drawn = prepared.options, prepared.points[prepared.drawn]
        returned = (logits >= options.min_score) & (np.arange(len(drawn)) < GRASPS)
        returned[options.top_k :] = False  # scores descend
        made = [*map(_top_down, drawn, logits.tolist())]
        grasps = [grasp for grasp, one in zip(made, returned, strict=True) if one]
        debug = DebugInfo(
            points=prepared.points,
            normals=np.tile(-DOWN, (len(prepared.points), 1)),
            approach_index=prepared.drawn,
            contact_index=prepared.drawn,
            T_cloud_hand=np.stack([grasp.T_cloud_hand for grasp in made]),
            score=np.where(returned, logits, np.float32(np.nan)),
            outcome=[Outcome.RETURNED if one else Outcome.NOT_SCORED for one in returned],
            support_plane=None,
            labels=np.zeros(len(prepared.points), dtype=np.int64),
        )
        counts = prepared.counts | {"returned": len(grasps)}
        seconds = prepared.seconds | {"total": sum(prepared.seconds.values())}
        gripper = choose_gripper(options, PANDA, {})
        outline = GripperOutline(gripper.name, gripper.palm_z, gripper.tip_z)
        debug_info = debug if options.debug else None
        return Detection(grasps, counts, seconds, NAME, outline, [WARNING], debug_info)

    def score(
        self,
        cloud: CloudInput,
        options: DetectOptions,
        *,
        edges: Array | None = None,
        hand_poses: Array | None = None,
        max_voxels: int = 0,
    ) -> Scoring:
        """Random scores; an edge from a row to itself defines no grasp."""
        checked = check_cloud(cloud)
        if edges is not None:
            rows = check_edges(edges, checked.rows_sent)
            nearest = np.searchsorted(checked.row, rows[:, 1]).clip(max=len(checked.row) - 1)
            contacts, is_grasp = checked.points[nearest], rows[:, 0] != rows[:, 1]
        else:
            poses = check_hand_poses(hand_poses)
            contacts = (poses @ np.array([0.0, 0.0, TCP_Z, 1.0], np.float32))[:, :3]
            is_grasp = np.ones(len(poses), dtype=bool)
        scores = np.random.default_rng(options.seed).random(len(contacts), dtype=np.float32)
        evaluations = [
            Evaluation(grasp, None) if one else Evaluation(None, NoGraspReason.TOO_SHORT)
            for grasp, one in zip(map(_top_down, contacts, scores.tolist()), is_grasp, strict=True)
        ]
        counts = {"points": len(checked.points), "scored": int(is_grasp.sum())}
        return Scoring(evaluations, counts, {"total": 0.0}, NAME, [WARNING])


class DummyCatalogue:
    """A catalogue with only the dummy detector."""

    unit_costs = UnitCosts()
    _detector = DummyDetector()

    def get(self, name: str = "") -> DummyDetector:
        """The detector; raises UnknownModel for any other name."""
        if name not in ("", NAME):
            raise UnknownModel(name, [NAME])
        return self._detector

    def describe(self) -> list[dict[str, Any]]:
        """The description of the dummy detector."""
        facts = {"name": NAME, "architecture": NAME, "gripper": "panda", "device": "cpu"}
        sizes = {"digest": "", "parameters": 0, "crop_radius": 0.0, "voxel_size": 0.0}
        return [facts | sizes | {"default": True, "hand_description": False}]


def _top_down(point: Float32, score: float) -> Grasp:
    T_cloud_tcp = np.diag(np.array([1, -1, -1, 1], np.float32))
    T_cloud_tcp[:3, 3] = point
    T_cloud_hand = T_cloud_tcp.copy()
    T_cloud_hand[:3, 3] -= TCP_Z * DOWN
    return Grasp(score, T_cloud_hand, T_cloud_tcp, 0.08, point, point, DOWN, True, 0.0)
