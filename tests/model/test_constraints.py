"""Whatever a request asks for, every grasp that comes back satisfies it.

The checks write the constraints down a second time and in another way than the pipeline does.
"""

import itertools
import math
from collections import Counter
from collections.abc import Callable

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.gripper import Gripper, load_gripper
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Detection, Grasp
from edgegrasp_model.scene.cloud import CloudInput

CASES = 500
ROWS = 1500  # of the cloud
TOLERANCE = 2e-5  # metres, of float32 poses half a metre from the origin
VOXEL_DIAGONAL = 0.0045 * math.sqrt(3)
STEPS = 7


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def unit(vector: tuple[float, float, float]) -> list[float]:
    return (np.array(vector) / np.linalg.norm(vector)).tolist()


somewhere = st.tuples(numbers(-0.03, 0.03), numbers(-0.04, 0.04), numbers(0.0, 0.09)).map(list)
direction = (
    st.tuples(numbers(-1, 1), numbers(-1, 1), numbers(-1, 1))
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(unit)
)
quaternion = (
    st.tuples(*[numbers(-1, 1)] * 4)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: (np.array(q) / np.linalg.norm(q)).tolist())
)
sizes = st.tuples(numbers(0.01, 0.08), numbers(0.01, 0.08), numbers(0.01, 0.08)).map(list)
oriented = st.fixed_dictionaries(
    {
        "kind": st.just("oriented_box"),
        "center": somewhere,
        "half_extents": sizes,
        "quaternion": quaternion,
    }
)
aligned = st.builds(
    lambda center, half: {
        "kind": "box",
        "min": np.subtract(center, half).tolist(),
        "max": np.add(center, half).tolist(),
    },
    somewhere,
    sizes,
)
shape = st.one_of(
    aligned,
    oriented,
    st.fixed_dictionaries(
        {"kind": st.just("sphere"), "center": somewhere, "radius": numbers(0.005, 0.06)}
    ),
    st.builds(
        lambda normal, point: {
            "kind": "half_space",
            "normal": normal,
            "offset": float(np.dot(normal, point)),
        },
        direction,
        somewhere,
    ),
    st.builds(
        lambda start, count: {"kind": "indices", "indices": list(range(start, start + count))},
        st.integers(0, ROWS // 2),
        st.integers(1, ROWS // 2),
    ),
    st.builds(
        lambda every: {"kind": "mask", "mask": [row % every > 0 for row in range(ROWS)]},
        st.integers(2, 6),
    ),
    st.fixed_dictionaries(
        {
            "kind": st.just("segments"),
            "ids": st.lists(st.integers(0, 3), min_size=1, max_size=2),
        }
    ),
)
region = st.one_of(
    st.none(),
    st.fixed_dictionaries(
        {
            "include": st.lists(shape, max_size=3),
            "exclude": st.lists(shape, max_size=1),
        }
    ),
)
support = st.one_of(
    st.none(),
    st.just({"kind": "ransac", "max_tilt": 1.6, "distance": 0.002}),
    st.builds(
        lambda tilt, offset: {"kind": "plane", "normal": unit((*tilt, 1.0)), "offset": offset},
        st.tuples(numbers(-0.3, 0.3), numbers(-0.3, 0.3)),
        numbers(-0.06, 0.02),
    ),
)
collision = st.fixed_dictionaries(
    {
        "mode": st.sampled_from(["avoid", "penalise", "ignore"]),
        "margin": st.one_of(st.just(0.0), numbers(0.0, 0.006)),
        "opening": st.one_of(st.none(), numbers(0.05, 0.08)),
        "approach_length": numbers(0.0, 0.2),
        "retreat_length": numbers(0.0, 0.2),
        "retreat_direction": st.sampled_from(["back", "up"]),
        "obstacles": st.lists(
            st.one_of(aligned, oriented).map(
                lambda box: (
                    box
                    | (
                        {"center": [box["center"][0] - 0.12, *box["center"][1:]]}
                        if box["kind"] == "oriented_box"
                        else {
                            "max": [v + 0.1 for v in box["max"]],
                            "min": [v + 0.1 for v in box["min"]],
                        }
                    )
                )
            ),
            max_size=2,
        ),
    }
)
requests = st.fixed_dictionaries(
    {
        "gripper": st.sampled_from([None, "robotiq-2f-85", "wsg-50"]),
        "num_approach_points": st.integers(1, 12),
        "num_candidates": st.integers(1, 300),
        "sampling": st.sampled_from(["farthest", "uniform"]),
        "seed": st.integers(0, 2**63 - 1),
        "viewpoint": st.one_of(st.none(), st.just([0.3, 0.2, 0.4])),
        "up": st.one_of(st.just([0.0, 0.0, 1.0]), direction),
        "support": support,
        "workspace": st.one_of(
            st.none(),
            st.builds(
                lambda low, high: {"min": [-0.1, -0.1, low], "max": [0.1, high, 0.2]},
                numbers(-0.1, 0.03),
                numbers(0.0, 0.1),
            ),
        ),
        "approach_region": region,
        "contact_region": region,
        "approach_direction": st.one_of(
            st.none(),
            st.fixed_dictionaries(
                {
                    "cones": st.lists(
                        st.fixed_dictionaries(
                            {"direction": direction, "max_angle": numbers(0.1, math.pi)}
                        ),
                        min_size=1,
                        max_size=2,
                    ),
                    "preset": st.sampled_from([None, "top-down", "side"]),
                }
            ),
        ),
        "collision": collision,
        "min_score": numbers(0.0, 0.9),
        "top_k": st.integers(1, 40),
        "suppression": st.one_of(
            st.none(),
            st.fixed_dictionaries({"translation": numbers(0, 0.03), "rotation": numbers(0, 1.5)}),
        ),
        "order": st.sampled_from(["score", "highest", "clearance"]),
        "debug": st.just(True),
    }
)


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
    for name, point in (
        ("approach_region", grasp.approach_point),
        ("contact_region", grasp.contact_point),
    ):
        region = fields[name]
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
    rows = np.zeros(len(sent.points), dtype=bool)
    match shape["kind"]:
        case "indices":
            rows[list(shape["indices"])] = True
        case "mask":
            rows[:] = shape["mask"]
        case "segments":
            rows[:] = [segment in shape["ids"] for segment in sent.segment_ids]
    if at_least_partly:
        return rows.any() and cKDTree(sent.points[rows]).query(x)[0] <= VOXEL_DIAGONAL
    return bool(rows[cKDTree(sent.points).query_ball_point(x, VOXEL_DIAGONAL)].all())


def check_direction(fields: dict, grasp: Grasp) -> None:
    up = np.array(fields["up"]) / np.linalg.norm(fields["up"])
    way = grasp.T_cloud_hand[:3, 2].astype(np.float64)
    np.testing.assert_array_equal(grasp.approach_direction, grasp.T_cloud_hand[:3, 2])
    asked = fields["approach_direction"]
    if asked is None:
        assert way @ up < 0.1 + 1e-5
        return
    down = math.acos(np.clip(-way @ up, -1, 1))
    allowed = [
        math.acos(
            np.clip(way @ np.array(cone["direction"]) / np.linalg.norm(cone["direction"]), -1, 1)
        )
        <= cone["max_angle"] + 1e-3
        for cone in asked["cones"]
    ]
    allowed.append(asked["preset"] == "top-down" and down <= math.radians(30) + 1e-3)
    allowed.append(asked["preset"] == "side" and abs(down - math.pi / 2) <= math.radians(30) + 1e-3)
    assert any(allowed)


def check_pose(fields: dict, grasp: Grasp, gripper: Gripper) -> None:
    turn = grasp.T_cloud_hand[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    tcp = grasp.T_cloud_hand @ [0.0, 0.0, gripper.tcp_z, 1.0]
    np.testing.assert_allclose(grasp.T_cloud_tcp[:, 3], tcp, atol=1e-6)
    assert 0.0 < grasp.width <= gripper.max_opening + 1e-6
    a, c = (
        (p - grasp.T_cloud_hand[:3, 3]) @ turn for p in (grasp.approach_point, grasp.contact_point)
    )
    assert abs(c[1] - a[1]) < gripper.max_opening / 2
    assert a[2] > gripper.palm_z - 0.006  # drawn back at most to the tips
    assert gripper.palm_z < c[2] < gripper.max_tip_z


def ways(fields: dict, grasp: Grasp) -> list[np.ndarray]:
    """Offsets (3,) of the hand from the grasp along the way in and out."""
    request = fields["collision"]
    up = np.array(fields["up"]) / np.linalg.norm(fields["up"])
    back = -grasp.T_cloud_hand[:3, 2].astype(np.float64)
    out = up if request["retreat_direction"] == "up" else back
    return [back * request["approach_length"] * t for t in np.linspace(0, 1, STEPS)] + [
        out * request["retreat_length"] * t for t in np.linspace(0, 1, STEPS)
    ]


def check_support(fields: dict, found: Detection, grasp: Grasp, gripper: Gripper) -> None:
    assert found.debug is not None
    plane = found.debug.support_plane
    if plane is None:
        return
    for point in (grasp.approach_point, grasp.contact_point):
        assert point @ plane[:3] > plane[3]
    boxes = gripper.boxes(gripper.max_opening)
    corners = np.array(
        [
            [box[i][0], box[j][1], box[k][2]]
            for box in boxes
            for i, j, k in itertools.product((0, 1), repeat=3)
        ]
    )
    heights = (corners @ grasp.T_cloud_hand[:3, :3].T + grasp.T_cloud_hand[:3, 3]) @ plane[:3]
    lowest = heights.min() - plane[3]
    margin = fields["collision"]["margin"]
    assert lowest >= margin - TOLERANCE
    assert grasp.clearance <= lowest + TOLERANCE
    if grasp.collision_free:
        for offset in ways(fields, grasp):
            assert lowest + offset @ plane[:3] >= margin - TOLERANCE


def check_collision(fields: dict, found: Detection, grasp: Grasp, gripper: Gripper) -> None:
    assert found.debug is not None
    request = fields["collision"]
    solid = [found.debug.points.astype(np.float64)]
    solid += [lattice(box) for box in request["obstacles"]]
    points = (np.concatenate(solid) - grasp.T_cloud_hand[:3, 3]) @ grasp.T_cloud_hand[:3, :3]
    boxes = gripper.boxes(gripper.max_opening)
    distance = min(box_distance(points, low, high).min() for low, high in boxes)
    assert grasp.clearance <= distance + TOLERANCE
    if not request["obstacles"] and found.debug.support_plane is None:
        np.testing.assert_allclose(grasp.clearance, distance, atol=TOLERANCE)
    if not grasp.collision_free:
        assert request["mode"] != "avoid"
        return
    assert grasp.clearance >= request["margin"] - TOLERANCE
    for offset in ways(fields, grasp):
        moved = points - offset @ grasp.T_cloud_hand[:3, :3]
        for low, high in boxes:
            grown = request["margin"] - TOLERANCE
            assert not ((moved > low - grown) & (moved < high + grown)).all(axis=1).any()


def lattice(box: dict) -> np.ndarray:
    """Points (343, 3) in a box of a request."""
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 3), -1).reshape(-1, 3)
    if box["kind"] == "oriented_box":
        return (
            Rotation.from_quat(box["quaternion"]).apply(steps * box["half_extents"]) + box["center"]
        )
    low, high = np.array(box["min"]), np.array(box["max"])
    return low + (steps + 1) / 2 * (high - low)


def box_distance(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Signed distances of points (N, 3) to a box."""
    beyond = np.maximum(low - points, points - high)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.where(outside > 0, outside, beyond.max(axis=1))


def check_order(fields: dict, grasps: list[Grasp]) -> None:
    up = np.array(fields["up"]) / np.linalg.norm(fields["up"])
    free = [grasp.collision_free or fields["collision"]["mode"] == "ignore" for grasp in grasps]
    if fields["order"] == "clearance":
        assert free == sorted(free, reverse=True)
        for half in (True, False):
            wide = [
                grasp.clearance
                for grasp, is_free in zip(grasps, free, strict=True)
                if is_free is half
            ]
            assert all(a >= b - 1e-6 for a, b in itertools.pairwise(wide))
        return
    worth = [g.score if is_free else g.score / 2 for g, is_free in zip(grasps, free, strict=True)]
    sure = sum(value >= 0.9 for value in worth) if fields["order"] == "highest" else 0
    heights = [float(grasp.T_cloud_tcp[:3, 3] @ up) for grasp in grasps[:sure]]
    assert all(a >= b - 1e-5 for a, b in itertools.pairwise(heights))
    assert all(value >= 0.9 for value in worth[:sure])
    assert all(a >= b - 1e-6 for a, b in itertools.pairwise(worth[sure:]))


def check_suppression(fields: dict, grasps: list[Grasp]) -> None:
    rule = fields["suppression"]
    if rule is None or len(grasps) < 2:
        return
    turns = Rotation.from_matrix([grasp.T_cloud_tcp[:3, :3] for grasp in grasps])
    flip = Rotation.from_euler("z", math.pi)
    tcp = np.array([grasp.T_cloud_tcp[:3, 3] for grasp in grasps])
    for i in range(1, len(grasps)):
        one, others = turns[i], turns[:i]
        angle = np.minimum(
            (one.inv() * others).magnitude(), ((one * flip).inv() * others).magnitude()
        )
        near = np.linalg.norm(tcp[:i] - tcp[i], axis=1) < rule["translation"] - 1e-6
        assert not (near & (angle < rule["rotation"] - 2e-3)).any()


def test_every_grasp_satisfies_every_constraint(
    plus: GraspDetector, box_on_table: Callable[..., np.ndarray]
) -> None:
    cloud = box_on_table(count=ROWS // 3)
    segments = np.repeat([0, 1, 2], ROWS // 3)  # the box's faces
    sent = CloudInput(cloud, segment_ids=segments)
    seen: Counter[str] = Counter()

    @settings(
        max_examples=CASES,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(fields=requests)
    def run(fields: dict) -> None:
        found = plus.detect(sent, DetectOptions.model_validate(fields))
        gripper = load_gripper(fields["gripper"] or "panda")
        opening = fields["collision"]["opening"]
        check(fields, sent, found, gripper.opened_to(opening) if opening else gripper)
        seen["cases"] += 1
        seen["with grasps"] += bool(found.grasps)
        seen["grasps"] += len(found.grasps)
        for name in ("approach_region", "contact_region", "approach_direction", "support"):
            seen[name] += bool(found.grasps) and fields[name] is not None
        seen["obstacles"] += bool(found.grasps) and bool(fields["collision"]["obstacles"])

    run()
    assert seen["cases"] >= CASES
    assert min(seen.values()) >= 50, seen  # none of them holds for want of grasps
