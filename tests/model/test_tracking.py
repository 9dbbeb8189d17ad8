"""Previous grasps: found again where their object is, first unless another is clearly better."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from edgegrasp_model import tracking as following
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import Collision, parse_options
from edgegrasp_model.scene.cloud import pose_matrix
from edgegrasp_results import Evaluation, Grasp

from .scenes import PANDA, grid, scene_of

BLOCK = grid(*[np.arange(0, 0.04, 0.004)] * 3)  # (1000, 3)
NOTHING = np.zeros((9, 3), np.float32)  # points in one place


def box_corner(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of three sides of a box of 6 x 4 x 8 cm, as voxels sample them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (1500, 3))
    axis = rng.integers(0, 3, 1500)
    points[np.arange(1500), axis] = 1.0
    noise = rng.normal(0.0, 0.0005, points.shape)
    return points * (0.03, 0.02, 0.04) + noise, np.eye(3)[axis]


def seen(points: np.ndarray, normals: np.ndarray) -> following.Surface:
    """Points (N, 3) and their normals as the surface that a camera sees."""
    return following.Surface(*np.float32([points, normals]), cKDTree(points))


@pytest.mark.parametrize("millimetres", [(0, 0, 0), (5, -3, 0), (20, 0, 0)])
@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_an_object_is_found_where_it_was_moved_to(millimetres: Any, degrees: float) -> None:
    before, _ = box_corner(0)
    points, normals = box_corner(1)
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    shift = np.array(millimetres) / 1000
    points, normals = points @ turn.T + shift, normals @ turn.T
    surface = seen(points, normals)
    T, share = following.register_icp(following.sampled(before), surface)
    assert share > 0.9
    apart = np.linalg.norm(before @ T[:3, :3].T + T[:3, 3] - (before @ turn.T + shift), axis=1)
    assert apart.max() < 0.003
    _, share = following.register_icp(np.repeat(points[:1], 9, axis=0), surface)  # all in one place
    assert share == 1.0


def test_the_surface_of_an_object_has_no_points_of_another() -> None:
    blocks = [BLOCK + np.array([x, 0, 0]) for x in (0.0, 0.3, 0.6)]
    points = np.concatenate(blocks).astype(np.float32)
    scene = scene_of(points, object_of_point=np.repeat([0, 1, 2], len(BLOCK)))
    before = {"number": 0, "surface": (BLOCK[::8] + np.array([0.6, 0, 0])).ravel().tolist()}
    previous = parse_options({"previous": {"objects": [before]}}).previous
    assert previous is not None
    _, followed = following.follow(scene, previous, given=False, chosen=False)
    assert len(followed.surface) == 3
    assert all(np.ptp(one[:, 0]) < 0.1 for one in followed.surface.values())


def test_a_can_does_not_turn_with_a_camera_that_goes_around_it() -> None:
    rng, total = np.random.default_rng(0), 0.0
    before: np.ndarray | None = None
    for camera in np.radians(range(0, 60, 2)):
        angle = rng.uniform(-1.4, 1.4, 600)
        outward = Rotation.from_euler("z", (camera + angle)[:, None]).apply([1.0, 0.0, 0.0])
        points = 0.03 * outward + np.outer(rng.uniform(0.0, 0.12, 600), [0.0, 0.0, 1.0])
        points += rng.normal(0.0, 0.0005, points.shape)
        normals = Rotation.from_euler("z", (camera + 0.9 * angle)[:, None]).apply([1.0, 0.0, 0.0])
        surface = seen(points, normals)
        if before is not None:
            T, _ = following.register_icp(before, surface)
            total += Rotation.from_matrix(T[:3, :3]).as_rotvec(degrees=True)[2]
        before = following.sampled(points.astype(np.float32)).astype(np.float64)
    assert abs(total) < 6


def test_all_points_of_a_large_object_belong_to_it() -> None:
    points = grid(np.arange(0, 0.4, 0.0045), np.arange(0, 0.3, 0.0045), [0.0]).astype(np.float32)
    surface = seen(points, np.broadcast_to([0, 0, 1], points.shape))
    assert len(surface.near(following.sampled(points).astype(np.float64))) > 0.99 * len(points)


def grasp(score: float, x: float, clearance: float = 0.01, z: float = -1.0) -> Grasp:
    pose = np.diag(np.float32([1, z, z, 1]))
    pose[0, 3] = x
    place, free = pose[:3, 3], clearance >= 0.0
    return Grasp(score, pose, pose, 0.08, place, place, pose[:3, 2], free, clearance, 0)


COLLIDING = grasp(0.9, 0.0, clearance=-0.02)


def earlier(gripper: str = "panda", x: float = 0.0, z: float = 0.0) -> dict[str, Any]:
    """What is sent of an earlier answer: a grasp with the id 7 on the object 0."""
    pose = pose_matrix(np.eye(3), (x, 0.0, z)).ravel().tolist()
    return {"gripper": gripper, "grasps": [{"id": 7, "T_cloud_hand": pose, "object": 0}]}


def answer(found: list[Grasp], now: Grasp | None, search: bool = True, **options: Any) -> Any:
    """What becomes of the earlier grasp, which is `now`, beside those found anew; the tracking."""
    asked = parse_options({"previous": earlier() | {"search": search}, **options})
    moved = {} if now is None else {0: (np.eye(4), 0)}
    scene = scene_of(NOTHING)
    followed = following.Followed(moved, {}, {}, 8)

    def score(_: object, rule: Collision) -> list[Evaluation]:
        free = now is not None and now.clearance >= rule.margin
        return [Evaluation(now and replace(now, collision_free=free), None)]

    return following.merged(found, followed, asked, scene, PANDA, score)


@pytest.mark.parametrize("top_k", [1, 2])
def test_a_grasp_stays_first_unless_another_is_better_by_a_margin(top_k: int) -> None:
    grasps, tracking = answer([grasp(0.88, 0.2)], grasp(0.8, 0.0), top_k=top_k)
    assert ([one.id for one in grasps], tracking.first) == ([7, 8][:top_k], "kept")
    assert tracking.next_id == 9
    grasps, tracking = answer([grasp(0.95, 0.2)], grasp(0.8, 0.0))
    assert ([one.id for one in grasps], tracking.first) == ([8, 7], "replaced")
    grasps, tracking = answer([grasp(0.95, 0.2)], grasp(0.8, 0.0), search=False)
    assert ([one.id for one in grasps], tracking.first) == ([7, 8], "kept")
    assert answer([grasp(0.85, 0.2)], grasp(0.8, 0.0, clearance=-0.004))[1].first == "kept"
    grasps, tracking = answer([grasp(0.6, 0.2)], COLLIDING, collision="ignore")
    assert ([one.id for one in grasps], tracking.first) == ([7, 8], "kept")


def test_new_grasps_near_each_other_stay_without_suppression_but_not_near_the_followed() -> None:
    grasps, tracking = answer([grasp(0.95, 0.001)], grasp(0.5, 0.0))
    assert ([one.id for one in grasps], tracking.first) == ([7], "kept")
    found = [grasp(0.95, 0.001), grasp(0.6, 0.2), grasp(0.55, 0.201)]
    for suppression, ids in (({}, [7, 9]), (None, [7, 9, 10])):
        grasps, _ = answer(found, grasp(0.9, 0.0), suppression=suppression)
        assert [one.id for one in grasps] == ids


@pytest.mark.parametrize("now", [None, grasp(0.1, 0.0), COLLIDING, grasp(0.9, 0.0, z=1.0)])
def test_a_grasp_that_is_gone_fails_collides_or_comes_from_below_is_lost(now: Grasp | None) -> None:
    grasps, tracking = answer([grasp(0.6, 0.2)], now)
    assert (grasps[0].id, tracking.first) == (8, "lost")


@pytest.mark.parametrize("sent", [{}, {"next_id": 3}, {"next_id": 8}])
def test_new_ids_are_above_all_that_are_sent(sent: Any) -> None:
    sent |= earlier() | {"objects": [{"number": 4, "surface": [0.0, 0.0, 0.0]}]}
    previous = parse_options({"previous": sent}).previous
    assert following.untracked(previous).next_id == 8
    late = previous.model_copy(update={"next_id": 2**29})  # ids stay small
    assert following.untracked(late).next_id == 8


def test_a_followed_grasp_has_the_score_of_the_same_grasp_found_anew() -> None:
    """A new grasp's score is averaged over similar hands; a followed one is a single pose."""
    grasps, tracking = answer([grasp(0.85, 0.001), grasp(0.8, 0.2)], grasp(0.6, 0.0))
    assert ([one.id for one in grasps], tracking.first) == ([7, 9], "kept")
    assert grasps[0].score == pytest.approx(0.85)


@pytest.mark.parametrize(
    ("gripper", "x", "error"),
    [
        ("wsg-50", 0.0, r"options.previous.gripper: got 'wsg-50'. Send what was found for 'panda'"),
        ("panda", 7.0, r"options.previous: got grasps 7 m from .* in the frame of this cloud"),
    ],
)
def test_previous_of_another_hand_or_frame_is_refused(gripper: str, x: float, error: str) -> None:
    asked = parse_options({"previous": earlier(gripper, x)})
    with pytest.raises(InvalidRequest, match=error):
        following.narrowed(asked, "panda", NOTHING)


def test_what_is_hidden_behind_something_near_the_camera_is_not_of_another_frame() -> None:
    asked = parse_options({"previous": earlier(z=0.8), "viewpoint": (0, 0, 0)})
    plate = np.random.default_rng(0).uniform(-0.1, 0.1, (500, 3)).astype(np.float32)
    plate[:, 2] = 0.1
    assert following.narrowed(asked, "panda", plate).previous is not None


@pytest.mark.parametrize(("begin", "low"), [(-0.1, -0.03), (0.0, 0.0), (0.2, 0.2)])
def test_objects_are_followed_in_the_workspace_only(begin: float, low: float) -> None:
    workspace = {"min": (begin, -1, -1), "max": (1, 1, 1)}
    previous = {"objects": [{"number": 0, "surface": [0, 0, 0]}], "search": False}
    asked = parse_options({"previous": previous, "workspace": workspace})
    box = following.narrowed(asked, "panda", NOTHING).workspace
    assert box.min[0] == low
