"""Whatever a request asks for, every grasp that comes back satisfies it.

The checks write the constraints down a second time and in another way than the pipeline does.
"""

import itertools
import math
from collections import Counter

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from edgegrasp_model.gripper import Gripper, load_gripper
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Detection, Grasp

from .scenes import box_on_table, detector, grid

CASES = 75  # for each seed
ROWS = 1500  # of the cloud
TOLERANCE = 2e-5  # metres, of float32 poses half a metre from the origin
VOXEL_DIAGONAL = 0.0045 * math.sqrt(3)
# Scores among which how the hand lies decides, and how many good ones surround the first.
CLOSE, SURROUNDED = 0.1, 0.08
STEPS = 7


class Draw:
    """Random parts of requests."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def number(self, low: float, high: float) -> float:
        """Between two ends, or one of them."""
        return float(np.clip(self.rng.uniform(low - 0.05 * (high - low), high), low, high))

    def whole(self, low: int, high: int) -> int:
        """From `low` to `high`."""
        return int(self.rng.integers(low, high, endpoint=True))

    def one_of(self, *choices):
        """A choice, called where it is a function."""
        chosen = choices[self.whole(0, len(choices) - 1)]
        return chosen() if callable(chosen) else chosen

    def point(self) -> list[float]:
        """Somewhere about the box."""
        return [self.number(-0.03, 0.03), self.number(-0.04, 0.04), self.number(0.0, 0.09)]

    def direction(self, size: int = 3) -> list[float]:
        """A unit vector."""
        vector = self.rng.normal(size=size)
        return (vector / np.linalg.norm(vector)).tolist()

    def aligned(self) -> dict:
        center, half = np.array(self.point()), self.rng.uniform(0.01, 0.08, 3)
        return {"kind": "box", "min": (center - half).tolist(), "max": (center + half).tolist()}

    def oriented(self) -> dict:
        half, turn = self.rng.uniform(0.01, 0.08, 3).tolist(), self.direction(4)
        box = {"kind": "oriented_box", "center": self.point()}
        return box | {"half_extents": half, "quaternion": turn}

    def obstacle(self) -> dict:
        """A box beside the object."""
        box = self.one_of(self.aligned, self.oriented)
        for corner in {"min", "max"} & box.keys():
            box[corner] = [value + 0.1 for value in box[corner]]
        if "center" in box:
            box["center"][0] -= 0.12
        return box

    def sphere(self) -> dict:
        return {"kind": "sphere", "center": self.point(), "radius": self.number(0.005, 0.06)}

    def half_space(self) -> dict:
        normal = self.direction()
        offset = float(np.dot(normal, self.point()))
        return {"kind": "half_space", "normal": normal, "offset": offset}

    def rows(self) -> dict:
        start, end = self.whole(0, ROWS // 2), self.whole(ROWS // 2, ROWS)
        mask = (np.arange(ROWS) % self.whole(2, 6) > 0).tolist()
        segments = self.rng.integers(0, 4, self.whole(1, 2)).tolist()
        return self.one_of(
            {"kind": "indices", "indices": list(range(start, end))},
            {"kind": "mask", "mask": mask},
            {"kind": "segments", "ids": segments},
        )

    def region(self) -> dict:
        shapes = self.aligned, self.oriented, self.sphere, self.half_space, self.rows, self.rows
        return {
            "include": [self.one_of(*shapes) for _ in range(self.whole(0, 3))],
            "exclude": [self.one_of(*shapes) for _ in range(self.whole(0, 1))],
        }

    def support(self) -> dict:
        normal = np.array([self.number(-0.3, 0.3), self.number(-0.3, 0.3), 1.0])
        normal /= np.linalg.norm(normal)
        return self.one_of(
            {"kind": "ransac", "max_tilt": 1.6, "distance": 0.002},
            {"kind": "plane", "normal": normal.tolist(), "offset": self.number(-0.06, 0.02)},
        )

    def approach_direction(self) -> dict:
        cones = [
            {"direction": self.direction(), "max_angle": self.number(0.1, math.pi)}
            for _ in range(self.whole(1, 2))
        ]
        return {"cones": cones, "preset": self.one_of(None, "top-down", "side")}

    def collision(self) -> dict:
        return {
            "mode": self.one_of("avoid", "penalise", "ignore"),
            "margin": self.one_of(0.0, self.number(0.0, 0.006)),
            "opening": self.one_of(None, self.number(0.05, 0.08)),
            "approach_length": self.number(0.0, 0.2),
            "retreat_length": self.number(0.0, 0.2),
            "retreat_direction": self.one_of("back", "up"),
            "obstacles": [self.obstacle() for _ in range(self.whole(0, 2))],
        }

    def workspace(self) -> dict:
        low, high = self.number(-0.1, 0.03), self.number(0.0, 0.1)
        return {"min": [-0.1, -0.1, low], "max": [0.1, high, 0.2]}

    def suppression(self) -> dict:
        return {"translation": self.number(0, 0.03), "rotation": self.number(0, 1.5)}

    def request(self) -> dict:
        """Every field of a request that constrains an answer."""
        return {
            "gripper": self.one_of(None, "robotiq-2f-85", "wsg-50"),
            "num_approach_points": self.whole(1, 12),
            "num_candidates": self.whole(1, 300),
            "sampling": self.one_of("farthest", "uniform"),
            "seed": self.whole(0, 2**63 - 1),
            "viewpoint": self.one_of(None, [0.3, 0.2, 0.4]),
            "up": self.one_of([0.0, 0.0, 1.0], self.direction),
            "support": self.one_of(None, self.support, self.support),
            "workspace": self.one_of(None, self.workspace),
            "approach_region": self.one_of(None, self.region),
            "contact_region": self.one_of(None, self.region),
            "approach_direction": self.one_of(None, self.approach_direction),
            "collision": self.collision(),
            "min_score": self.number(0.0, 0.9),
            "top_k": self.whole(1, 40),
            "suppression": self.one_of(None, self.suppression),
            "order": self.one_of("score", "highest", "clearance"),
            "debug": True,
        }


@pytest.mark.parametrize("seed", range(2))
def test_every_grasp_satisfies_every_constraint(seed: int) -> None:
    cloud, segments = box_on_table(ROWS // 3), np.repeat([0, 1, 2], ROWS // 3)  # its faces
    sent, draw = CloudInput(cloud, segment_ids=segments), Draw(seed)
    seen: Counter[str] = Counter()
    for _ in range(CASES):
        fields = draw.request()
        found = detector().detect(sent, DetectOptions.model_validate(fields))
        gripper = load_gripper(fields["gripper"] or "panda")
        opening = fields["collision"]["opening"]
        check(fields, sent, found, gripper.opened_to(opening) if opening else gripper)
        seen["grasps"] += len(found.grasps)
        for name in ("approach_region", "contact_region", "approach_direction", "support"):
            seen[name] += bool(found.grasps) and fields[name] is not None
        seen["obstacles"] += bool(found.grasps) and bool(fields["collision"]["obstacles"])
    assert min(seen.values()) >= 10, seen  # none of them holds for want of grasps


def check(fields: dict, sent: CloudInput, found: Detection, gripper: Gripper) -> None:
    """Assert that every grasp satisfies every constraint of a request with all fields set."""
    grasps = found.grasps
    for grasp in grasps:
        check_regions(fields, sent, grasp)
        check_direction(fields, grasp)
        check_pose(fields, grasp, gripper)
        check_support(fields, found, grasp, gripper)
        check_collision(fields, found, grasp, gripper)
        assert grasp.score >= fields["min_score"] - 1e-6
    assert len(grasps) == found.counts["returned"] <= fields["top_k"]
    check_order(fields, grasps)
    check_suppression(fields, grasps)


def check_regions(fields: dict, sent: CloudInput, grasp: Grasp) -> None:
    for name in ("approach", "contact"):
        region, point = fields[f"{name}_region"], getattr(grasp, f"{name}_point")
        if region is not None:
            include, exclude = region["include"], region["exclude"]
            assert not include or any(holds(shape, sent, point, True) for shape in include)
            assert not any(holds(shape, sent, point, False) for shape in exclude)
        if fields["workspace"] is not None:
            assert (point >= np.array(fields["workspace"]["min"]) - 1e-6).all()
            assert (point <= np.array(fields["workspace"]["max"]) + 1e-6).all()


def holds(shape: dict, sent: CloudInput, point: np.ndarray, at_least_partly: bool) -> bool:
    """Whether a shape holds a point; rows: whether some, or all, points of its voxel can be."""
    x = point.astype(np.float64)
    match shape["kind"]:
        case "box":
            return all(a <= b <= c for a, b, c in zip(shape["min"], x, shape["max"], strict=True))
        case "oriented_box":
            own = Rotation.from_quat(shape["quaternion"]).inv().apply(x - shape["center"])
            return bool((abs(own) <= shape["half_extents"]).all())
        case "sphere":
            return math.dist(x, shape["center"]) <= shape["radius"]
        case "half_space":
            return float(np.dot(x, shape["normal"])) >= shape["offset"]
        case "indices":
            rows = np.isin(np.arange(ROWS), shape["indices"])
        case "mask":
            rows = np.array(shape["mask"])
        case _:
            rows = np.isin(sent.segment_ids, shape["ids"])
    if at_least_partly:
        return rows.any() and cKDTree(sent.points[rows]).query(x)[0] <= VOXEL_DIAGONAL
    return bool(rows[cKDTree(sent.points).query_ball_point(x, VOXEL_DIAGONAL)].all())


def check_direction(fields: dict, grasp: Grasp) -> None:
    way = grasp.T_cloud_hand[:3, 2].astype(np.float64)
    np.testing.assert_array_equal(grasp.approach_direction, grasp.T_cloud_hand[:3, 2])
    asked = fields["approach_direction"]
    if asked is None:
        assert way @ fields["up"] < 0.1 + 1e-5
        return
    down = angle(way, np.negative(fields["up"]))
    cones = asked["cones"]
    allowed = [angle(way, cone["direction"]) <= cone["max_angle"] + 1e-3 for cone in cones]
    allowed.append(asked["preset"] == "top-down" and down <= math.radians(30) + 1e-3)
    allowed.append(asked["preset"] == "side" and abs(down - math.pi / 2) <= math.radians(30) + 1e-3)
    assert any(allowed)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    return math.acos(np.clip(np.dot(one, other) / np.linalg.norm(other), -1, 1))


def check_pose(fields: dict, grasp: Grasp, gripper: Gripper) -> None:
    turn = grasp.T_cloud_hand[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    tcp = grasp.T_cloud_hand @ [0.0, 0.0, gripper.tcp_z, 1.0]
    np.testing.assert_allclose(grasp.T_cloud_tcp[:, 3], tcp, atol=1e-6)
    assert 0.0 < grasp.width <= gripper.max_opening + 1e-6
    ends = np.array([grasp.approach_point, grasp.contact_point])
    a, c = (ends - grasp.T_cloud_hand[:3, 3]) @ turn
    assert abs(c[1]) < gripper.max_opening / 2
    assert abs(a[1]) < gripper.max_opening / 2
    assert a[2] > gripper.palm_z - 0.006  # retracted at most to the tips
    assert gripper.palm_z < c[2] < gripper.max_tip_z


def ways(fields: dict, grasp: Grasp) -> np.ndarray:
    """Offsets (W, 3) of the hand from the grasp along the way in and out."""
    request, steps = fields["collision"], np.linspace(0, 1, STEPS)[:, None]
    back = -grasp.T_cloud_hand[:3, 2].astype(np.float64)
    out = np.array(fields["up"]) if request["retreat_direction"] == "up" else back
    approach, retreat = request["approach_length"] * back, request["retreat_length"] * out
    return np.concatenate([steps * approach, steps * retreat])


def check_support(fields: dict, found: Detection, grasp: Grasp, gripper: Gripper) -> None:
    plane, margin = found.debug.support_plane, fields["collision"]["margin"]
    if plane is None:
        return
    for point in (grasp.approach_point, grasp.contact_point):
        assert point @ plane[:3] > plane[3]
    ends = gripper.boxes(gripper.max_opening).transpose(0, 2, 1)  # (B, 3, 2)
    corners = np.concatenate([list(itertools.product(*box)) for box in ends])
    heights = (corners @ grasp.T_cloud_hand[:3, :3].T + grasp.T_cloud_hand[:3, 3]) @ plane[:3]
    lowest = heights.min() - plane[3]
    assert lowest >= margin - TOLERANCE
    assert grasp.clearance <= lowest + TOLERANCE
    if grasp.collision_free:
        assert (lowest + ways(fields, grasp) @ plane[:3] >= margin - TOLERANCE).all()


def check_collision(fields: dict, found: Detection, grasp: Grasp, gripper: Gripper) -> None:
    request, boxes = fields["collision"], gripper.boxes(gripper.max_opening)
    points = np.concatenate([found.debug.points, *map(lattice, request["obstacles"])])
    hand = grasp.T_cloud_hand[None].astype(np.float64)
    beyond = beyond_sides(points, hand, boxes)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=3)
    distance = np.where(outside > 0, outside, beyond.max(axis=3)).min()
    assert grasp.clearance <= distance + TOLERANCE
    if not request["obstacles"] and found.debug.support_plane is None:
        np.testing.assert_allclose(grasp.clearance, distance, atol=TOLERANCE)
    if not grasp.collision_free:
        assert request["mode"] != "avoid"
        return
    assert grasp.clearance >= request["margin"] - TOLERANCE
    offsets = ways(fields, grasp)
    hands = np.repeat(hand, len(offsets), axis=0)
    hands[:, :3, 3] += offsets
    grown = request["margin"] - TOLERANCE
    boxes += np.array([[-grown], [grown]])
    assert (beyond_sides(points, hands, boxes) >= 0).any(axis=3).all()


def lattice(box: dict) -> np.ndarray:
    """Points (343, 3) in a box of a request."""
    steps = grid(*[np.linspace(-1, 1, 7)] * 3)
    if box["kind"] == "oriented_box":
        turn = Rotation.from_quat(box["quaternion"])
        return turn.apply(steps * box["half_extents"]) + box["center"]
    low, high = np.array(box["min"]), np.array(box["max"])
    return low + (steps + 1) / 2 * (high - low)


def check_order(fields: dict, grasps: list[Grasp]) -> None:
    free = [grasp.collision_free or fields["collision"]["mode"] == "ignore" for grasp in grasps]
    if fields["order"] == "clearance":
        keys = [(is_free, g.clearance) for g, is_free in zip(grasps, free, strict=True)]
        assert keys == sorted(keys, reverse=True)
        return
    worth = [g.score if is_free else g.score / 2 for g, is_free in zip(grasps, free, strict=True)]
    if fields["order"] == "score":  # the best of each object come first
        firsts = len({grasp.object for grasp in grasps if grasp.score >= 0.5})
        apart = CLOSE + SURROUNDED
        assert all(a >= b - apart for a, b in itertools.pairwise(worth[:firsts]))
        assert len({grasp.object for grasp in grasps[:firsts]}) == firsts
        worth = worth[firsts:]
    sure = sum(value >= 0.9 for value in worth) if fields["order"] == "highest" else 0
    heights = [float(grasp.T_cloud_tcp[:3, 3] @ fields["up"]) for grasp in grasps[:sure]]
    assert all(a >= b - 1e-5 for a, b in itertools.pairwise(heights))
    assert all(value >= 0.9 for value in worth[:sure])
    apart = CLOSE if fields["order"] == "score" else 1e-6
    assert all(a >= b - apart for a, b in itertools.pairwise(worth[sure:]))


def check_suppression(fields: dict, grasps: list[Grasp]) -> None:
    rule = fields["suppression"]
    if rule is None or len(grasps) < 2:
        return
    turns = Rotation.from_matrix([grasp.T_cloud_tcp[:3, :3] for grasp in grasps])
    flip = Rotation.from_euler("z", math.pi)
    tcp = np.array([grasp.T_cloud_tcp[:3, 3] for grasp in grasps])
    for i in range(1, len(grasps)):
        one, others = turns[i], turns[:i]
        angle = np.min([(way.inv() * others).magnitude() for way in (one, one * flip)], axis=0)
        near = np.linalg.norm(tcp[:i] - tcp[i], axis=1) < rule["translation"] - 1e-6
        assert not (near & (angle < rule["rotation"] - 2e-3)).any()


def beyond_sides(points: np.ndarray, T_cloud_hand: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """How far points (N, 3) are beyond the sides of boxes (B, 2, 3) of hands.  # (E, N, B, 3)."""
    shifted = points.astype(np.float64) - T_cloud_hand[:, None, :3, 3]
    position = (shifted @ T_cloud_hand[:, :3, :3].astype(np.float64))[:, :, None]
    return np.maximum(boxes[:, 0] - position, position - boxes[:, 1])


VIEW = [0.4, 0.15, 0.45]


def plane(moved: RigidTransform, normal: list[float], offset: float) -> dict[str, object]:
    """A plane of a scene that was moved."""
    turned = moved.rotation.apply(normal)
    return {"normal": turned.tolist(), "offset": offset + float(turned @ moved.translation)}


def constraints(moved: RigidTransform) -> dict[str, object]:
    """Every kind of constraint that is not bound to the frame's axes."""
    box = {"kind": "oriented_box", "center": moved.apply([0.0, 0.0, 0.05]).tolist()}
    box |= {"half_extents": [0.05] * 2 + [0.045], "quaternion": moved.rotation.as_quat().tolist()}
    hole = {"kind": "sphere", "center": moved.apply([0.02, 0.0, 0.08]).tolist(), "radius": 0.01}
    far = {"kind": "half_space", **plane(moved, [0.0, 1.0, 0.0], -0.02)}
    aside = moved.apply([-0.2, 0.0, 0.1]).tolist()
    wall = {**box, "center": aside, "half_extents": [0.02, 0.2, 0.1]}
    down = {"direction": moved.rotation.apply([-0.2, 0.1, -1.0]).tolist(), "max_angle": 0.9}
    lift = {"retreat_length": 0.06, "retreat_direction": "up"}
    return {
        "viewpoint": moved.apply(VIEW).tolist(),
        "up": moved.rotation.apply([0.0, 0.0, 2.0]).tolist(),
        "support": plane(moved, [0.0, 0.0, 1.0], 0.0),
        "approach_region": {"include": [box], "exclude": [hole]},
        "contact_region": {"include": [far]},
        "approach_direction": {"cones": [down], "preset": "top-down"},
        "collision": {"obstacles": [wall], "margin": 0.001, **lift},
        "num_approach_points": 16,
    }


def frame_only(moved: RigidTransform) -> dict[str, object]:
    return {"up": moved.rotation.apply([0.0, 0.0, 1.0]).tolist(), "num_approach_points": 16}


def found_plane(moved: RigidTransform) -> dict[str, object]:
    plane = {"viewpoint": moved.apply(VIEW).tolist(), "support": {"kind": "ransac"}}
    return frame_only(moved) | plane | {"order": "highest"}


@pytest.mark.parametrize("request_of", [constraints, frame_only, found_plane])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_turned_scene_has_the_same_grasps_turned(request_of, seed) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng)
    moved = RigidTransform.from_components(rng.uniform(-0.4, 0.4, 3), turn)
    cloud = box_on_table(4000, table=request_of is found_plane)
    here, there = (
        detector().detect(way.apply(cloud), DetectOptions.model_validate(request_of(way)))
        for way in (RigidTransform.identity(), moved)
    )
    assert len(here.grasps) >= 5
    for name, count in here.counts.items():  # a point on a border may fall on either side
        assert abs(there.counts[name] - count) <= 1 + 0.02 * count, name
    contacts = np.array([grasp.contact_point for grasp in there.grasps])
    for a in here.grasps[:5]:
        apart = np.linalg.norm(contacts - moved.apply(a.contact_point), axis=1)
        same = [there.grasps[row] for row in np.flatnonzero(apart < 5e-4)]
        rotation = turn.as_matrix() @ a.T_cloud_hand[:3, :3]
        assert any(
            np.allclose(b.T_cloud_hand[:3, :3], rotation, atol=5e-3)
            and np.allclose(b.T_cloud_tcp[:3, 3], moved.apply(a.T_cloud_tcp[:3, 3]), atol=1e-3)
            and abs(b.score - a.score) < 0.02
            and abs(b.clearance - a.clearance) < 1e-3
            and abs(b.width - a.width) < 1e-3
            for b in same
        )
