"""Requests whose answers are recorded, and the records: `python -m tests.answers.make`.

Answers are promised to stay what they are: record them again only for a change that is meant. The
requests are of clouds of the labelled views, of files of the repository and explicit seeds alone,
so that they are the same on every machine; their options are in the client's form.
"""

import json
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.networks import hand
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene import segment
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Grasp

DATA = Path(__file__).parent / "data"
VIEWS = Path(__file__).parents[2] / "examples" / "labelled_views"
GRASP_FIELDS = tuple(each.name for each in fields(Grasp) if each.default is MISSING)
TABLE_HEIGHT = 0.05  # metres, in the labelled views
TABLE = {"kind": "plane", "normal": (0.0, 0.0, 1.0), "offset": TABLE_HEIGHT}
FEW = {"num_approach_points": 12, "num_candidates": 150, "top_k": 20}  # for the ball networks

LONG_FINGERS = {"name": "long-fingers", "max_opening": 0.09, "tip_z": 0.13, "contact_z": 0.124} | {
    "tcp_z": 0.12,
    "hand": {"boxes": [[(-0.03, -0.1, -0.04), (0.03, 0.1, 0.06)]]},
    "finger": {"boxes": [[(-0.01, 0.0, 0.06), (0.01, 0.015, 0.13)]]},
}


@dataclass
class Case:
    """One request: a cloud, what is beside it, and options."""

    options: dict[str, Any]
    points: np.ndarray  # (N, 3) metres
    beside: dict[str, np.ndarray] = field(default_factory=dict)  # normals, segment_ids, view_ids
    given: dict[str, np.ndarray] = field(default_factory=dict)  # edges or hand_poses: score them


@cache
def view(name: str) -> dict[str, np.ndarray]:
    with np.load(VIEWS / f"{name}.npz") as arrays:
        return dict(arrays)


def camera(name: str) -> list[float]:
    return [float(number) for number in view(name)["camera_position"]]


def with_table(points: np.ndarray, seed: int) -> np.ndarray:
    """Points and a noisy table under them, 30 cm wide, a point every 6 mm."""
    side = np.arange(0.0, 0.3, 0.006)
    table = np.stack(np.meshgrid(side, side, [TABLE_HEIGHT]), axis=-1).reshape(-1, 3)
    noise = np.random.default_rng(seed).normal(0.0, 0.0005, table.shape)
    return np.concatenate([points, (table + noise).astype(np.float32)])


def seen(name: str, table_seed: int | None = None, **options: Any) -> Case:
    """A labelled view, with its camera as viewpoint and, by default, its table."""
    points = view(name)["points"]
    options = {"viewpoint": camera(name), "support": TABLE} | options
    return Case(options, points if table_seed is None else with_table(points, table_seed))


def packed_plane() -> Case:
    case = seen("packed_7-000002_0", 1, seed=3)
    case.points = case.points.astype(np.float64)
    return case


def pile_ransac() -> Case:
    options = {"support": {"kind": "ransac", "distance": 0.004}, "sampling": "uniform", "seed": 5}
    collision = {"mode": "penalise", "margin": 0.004}
    few = FEW | options
    return seen("pile_7-000013_0", 2, model="edgegrasp", collision=collision, **few)


def two_views() -> Case:
    first, second = "packed_7-000000_0", "packed_7-000010_0"
    near, far = with_table(view(first)["points"], 3), view(second)["points"]
    position = np.array(camera(first))
    near = ((near - position) * 1.01 + position).astype(np.float32)
    options = {
        "viewpoint": [camera(first), camera(second)],
        "support": TABLE | {"max_depth_error": 0.04},
        "suppression": {"translation": 0.02, "rotation": 1.0},
    }
    beside = {"view_ids": np.repeat([0, 1], [len(near), len(far)])}
    few = FEW | options | {"model": "vn-edgegrasp", "seed": 1}
    return Case(few, np.concatenate([near, far]), beside)


def given_normals() -> Case:
    name = "pile_7-000009_0"
    down = {"direction": (0.0, 0.0, -1.0), "max_angle": 0.5}
    slanted = {"direction": (1.0, 0.5, -1.0), "max_angle": 0.6}
    ball = {"kind": "sphere", "center": (0.12, 0.1, 0.08), "radius": 0.03}
    above = {"kind": "half_space", "normal": (0.0, 0.0, 1.0), "offset": 0.065}
    options = {
        "model": "vn-edgegrasp",
        "viewpoint": None,
        "approach_direction": {"cones": [down, slanted]},
        "contact_region": {"include": [above], "exclude": [ball]},
    }
    case = seen(name, seed=4, **FEW, **options)
    case.beside = {"normals": view(name)["normals"].astype(np.float32)}
    return case


def segments_own_gripper() -> Case:
    corner = {"kind": "box", "min": (0.1, 0.2, 0.0), "max": (0.14, 0.26, 0.2)}
    ball = {"kind": "sphere", "center": (0.1, 0.2, 0.08), "radius": 0.09}
    turn = {"quaternion": (0.0, 0.0, 0.5, 0.75**0.5)}
    extent = {"center": (0.1, 0.08, 0.08), "half_extents": (0.05, 0.06, 0.05)}
    segments = {"kind": "segments", "ids": [1, 2, 3]}
    options = {
        "model": "edgegrasp",
        "gripper": LONG_FINGERS,
        "approach_region": {"include": [segments], "exclude": [corner]},
        "contact_region": {"include": [ball, {"kind": "oriented_box"} | extent | turn]},
    }
    case = seen("pile_7-000001_0", seed=6, **FEW, **options)
    x, y, _ = case.points.T
    case.beside = {"segment_ids": (x > 0.1) + 2 * (y > 0.15).astype(np.int64)}
    return case


def score_edges() -> Case:
    name = "packed_7-000012_0"
    case, arrays = seen(name, seed=15), view(name)
    edges = np.stack([arrays["approach_index"], arrays["contact_index"]], axis=1).astype(np.int64)
    edges[::4, 1] = edges[::-4, 0]  # most of these are longer than the hand opens
    edges[5, 1] = edges[5, 0]
    case.given = {"edges": edges}
    return case


def score_hand_poses() -> Case:
    name = "pile_7-000011_0"
    poses = view(name)["T_world_hand"][:40].copy()
    poses[::8, 2, 3] += 0.3  # far above everything
    case = seen(name, model="edgegrasp", collision="penalise")
    case.given = {"hand_poses": poses}
    return case


MAKERS = (packed_plane, pile_ransac, two_views, given_normals)
MAKERS += (segments_own_gripper, score_edges, score_hand_poses)
CASES = {make.__name__: make for make in MAKERS}


Record = tuple[dict[str, Any], dict[str, np.ndarray]]


def answer(case: Case, catalogue: ModelCatalogue) -> Any:
    """The detection or scoring of a case, without a server, in float32 on every processor."""
    cloud, asked = CloudInput(case.points, **case.beside), parse_options(case.options)
    detector = catalogue.get(asked.model)
    with (
        patch.object(segment, "FAST", torch.float32),
        patch.object(hand, "FAST", torch.float32),
    ):
        if case.given:
            return detector.score(cloud, asked, **case.given)
        return detector.detect(cloud, asked)


def record(answer: Any) -> Record:
    """What is kept of an answer, of the model's or of the client's: plain values and arrays."""
    plain = {"counts": dict(answer.counts), "model": answer.model, "warnings": len(answer.warnings)}
    grasps = getattr(answer, "grasps", None)
    if grasps is None:
        plain["reasons"] = [each.reason and str(each.reason) for each in answer.evaluations]
        grasps = [each.grasp for each in answer.evaluations if each.grasp is not None]
    arrays = {
        name: np.array([getattr(grasp, name) for grasp in grasps], dtype=np.float32)
        for name in GRASP_FIELDS
    }
    return plain, arrays


def load(name: str) -> Record:
    """The recorded answer of a case."""
    with np.load(DATA / f"{name}.npz") as arrays:
        found = dict(arrays)
    return json.loads(str(found.pop("plain"))), found


def main() -> None:
    catalogue = ModelCatalogue.load()
    for name, make in CASES.items():
        plain, arrays = record(answer(make(), catalogue))
        np.savez_compressed(DATA / f"{name}.npz", plain=np.array(json.dumps(plain)), **arrays)


if __name__ == "__main__":
    main()
