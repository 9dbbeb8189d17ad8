"""Each stage on a device beside the one on the processor, also where work goes piece by piece."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgegrasp_model import ball_batch, candidates, cloud, collision, ranking, sampling
from edgegrasp_model.canonical_frame import CanonicalFrame
from edgegrasp_model.cloud import Cloud
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.obstacles import SolidBoxes
from edgegrasp_model.on_device import balls as device_balls
from edgegrasp_model.on_device import candidates as device_candidates
from edgegrasp_model.on_device import cloud as device_cloud
from edgegrasp_model.on_device import collision as device_collision
from edgegrasp_model.on_device import hand_view as device_hand_view
from edgegrasp_model.on_device import sampling as device_sampling
from edgegrasp_model.on_device import selection as device_selection
from edgegrasp_model.on_device.cloud import DeviceCloud
from edgegrasp_model.on_device.scene import DeviceScene
from edgegrasp_model.options import Collision, Suppression
from edgegrasp_model.scene import Scene
from edgegrasp_model.support import SupportPlane

Float32 = NDArray[np.float32]


@pytest.fixture
def points() -> Float32:
    rng = np.random.default_rng(0)
    return (rng.uniform(-0.06, 0.06, (300, 3)) * (1.0, 1.0, 0.3)).astype(np.float32)


@pytest.fixture
def normals() -> Float32:
    normals = np.random.default_rng(1).normal(size=(300, 3))
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def hands(count: int) -> Float32:
    """Random hands that look down on the points, more or less."""
    rng = np.random.default_rng(2)
    poses = np.zeros((count, 4, 4), np.float32)
    turn = Rotation.from_euler("xyz", rng.normal(0, 0.5, (count, 3))) * Rotation.from_quat(
        [1.0, 0.0, 0.0, 0.0]
    )
    poses[:, :3, :3] = turn.as_matrix()
    poses[:, :3, 3] = rng.uniform((-0.1, -0.1, 0.03), (0.1, 0.1, 0.23), (count, 3))
    poses[:, 3, 3] = 1.0
    return poses


@pytest.fixture(params=[False, True], ids=["at once", "in pieces"])
def pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    if request.param:
        for module in (device_cloud, device_balls, device_candidates):
            monkeypatch.setattr(module, "PAIRS", 700)
        monkeypatch.setattr(device_hand_view, "SEEN", 700)
    return bool(request.param)


def test_voxels(points: Float32) -> None:
    there = cloud.voxelise(points.astype(np.float64), 0.01)
    here = device_cloud.voxelise(torch.from_numpy(points).double(), 0.01)
    assert 50 < len(there.size) < 300
    np.testing.assert_array_equal(there.voxel, here.voxel)
    np.testing.assert_array_equal(there.size, here.size)
    mean = here.mean(torch.from_numpy(points).double())
    np.testing.assert_array_equal(there.mean(points.astype(np.float64)), mean)
    labels = np.random.default_rng(0).integers(0, 3, len(points))
    np.testing.assert_array_equal(
        there.commonest(labels, 3), here.commonest(torch.from_numpy(labels), 3)
    )


def test_outliers_and_normals(points: Float32, pieces: bool) -> None:
    points[7] = (0.2, 0.2, 0.2)
    there, here = cloud.inliers(points), device_cloud.inliers(torch.from_numpy(points))
    assert not there[7]
    np.testing.assert_array_equal(there, here)
    expected = cloud.estimate_normals(points)
    found = device_cloud.estimate_normals(torch.from_numpy(points)).numpy()
    along = np.abs((expected * found).sum(axis=1))
    np.testing.assert_allclose(along, 1.0, atol=1e-6)


def test_least_directions_of_any_spread() -> None:
    rng = np.random.default_rng(3)
    spread = rng.uniform(size=(500, 3)) ** 6  # some nearly flat, some nearly lines
    spread[:20, 0] = 0.0
    turn = Rotation.random(500, random_state=0).as_matrix()
    matrices = turn @ (spread[:, :, None] * turn.transpose(0, 2, 1))
    matrices *= 10.0 ** rng.uniform(-8, 3, (500, 1, 1))
    found = device_cloud.least_directions(torch.from_numpy(matrices)).numpy()
    values, _ = np.linalg.eigh(matrices)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    reached = np.einsum("nd,ndk,nk->n", found, matrices, found)
    np.testing.assert_allclose(reached / values[:, 2], values[:, 0] / values[:, 2], atol=1e-8)


def test_least_directions_where_any_will_do() -> None:
    alike = torch.stack([torch.eye(3), torch.zeros(3, 3), torch.diag(torch.ones(3)) * 1e-9])
    found = device_cloud.least_directions(alike.double())
    torch.testing.assert_close(found.norm(dim=1), torch.ones(3, dtype=torch.float64))


@pytest.mark.parametrize("method", ["farthest", "uniform"])
@pytest.mark.parametrize("count", [1, 30, 400])
def test_approach_points(points: Float32, method: Any, count: int) -> None:
    there = sampling.sample_approach_points(points, count, method, np.random.default_rng(5))
    here = device_sampling.sample_approach_points(
        torch.from_numpy(points), count, method, np.random.default_rng(5)
    )
    assert len(there) == min(count, 300)
    np.testing.assert_array_equal(there, here)


@pytest.mark.parametrize("radius", [0.004, 0.03])  # in small balls the own row fills up
def test_balls_and_neighbours(points: Float32, radius: float, pieces: bool) -> None:
    chosen = np.array([3, 77, 200, 12])
    there = ball_batch.crop_balls(points, chosen, radius)
    tensor, index = torch.from_numpy(points), torch.from_numpy(chosen)
    here = device_balls.crop_balls(tensor, index, radius)
    np.testing.assert_array_equal(there.ball_rows, here.ball_rows)
    np.testing.assert_array_equal(there.ball_of_point, here.ball_of_point)
    near = ball_batch.nearest_in_ball(points, chosen, there, 16)
    centred = tensor[here.ball_rows] - tensor[index][here.ball_of_point]
    found = device_balls.nearest_in_ball(centred, here, 4, 16)
    np.testing.assert_array_equal(near, found)


def test_candidates(points: Float32, normals: Float32, pieces: bool) -> None:
    rng = np.random.default_rng(6)
    normals[::3] = (0.0, 0.0, 1.0)  # tops, whose outline says where to close
    pairs = rng.integers(0, 300, (2, 4000))
    tensors = [torch.from_numpy(one) for one in pairs]
    support = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.02)
    floor = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.08)
    there_cloud = Cloud(points, normals)
    here_cloud = DeviceCloud(torch.from_numpy(points), torch.from_numpy(normals))
    for name in ("panda", "robotiq-2f-140"):
        hand = load_gripper(name)
        there = candidates.edge_grasps(there_cloud, *pairs, hand)
        here = device_candidates.edge_grasps(here_cloud, *tensors, hand)
        assert_same_candidates(there, here)
        level = candidates.level_grasps(there_cloud, *pairs, support, hand)
        level_here = device_candidates.level_grasps(here_cloud, *tensors, support, hand)
        assert_same_candidates(level, level_here)
        for margin in (0.0, 0.01):
            back, clear = candidates.drawn_back(there, floor, hand, margin)
            back_here, clear_here = device_candidates.drawn_back(here, floor, hand, margin)
            assert 0 < clear.sum() < len(clear)
            np.testing.assert_array_equal(clear, clear_here)
            assert_same_candidates(back, back_here)


def assert_same_candidates(
    there: candidates.Candidates, here: device_candidates.DeviceCandidates
) -> None:
    assert len(there) > 20
    for name in ("pair", "approach_index", "contact_index"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    for name in ("approach", "depth", "T_cloud_hand"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), atol=2e-5)


@pytest.mark.parametrize(
    "request_fields",
    [
        {},
        {"margin": 0.01, "approach_length": 0.0},
        {"retreat_length": 0.2, "retreat_direction": "up"},
        {"retreat_length": 0.3, "retreat_direction": "back"},
    ],
)
def test_collisions_and_clearances(
    points: Float32, normals: Float32, request_fields: dict[str, Any], pieces: bool
) -> None:
    asked = Collision.model_validate(request_fields)
    poses = hands(120)
    tensor = torch.from_numpy(poses)
    some, none = np.ones(300, dtype=bool), np.empty(0, dtype=np.int64)
    frame = CanonicalFrame(np.eye(4))
    boxes = SolidBoxes(np.array([[0.2, 0.0, 0.1]]), np.array([np.eye(3) * 0.08]))
    support = SupportPlane(normal=(0.0, 0.0, 1.0), offset=-0.05)
    for plane, obstacles in ((support, boxes), (support, boxes.take(none)), (None, boxes)):
        shared = {"frame": frame, "support": plane, "obstacles": obstacles, "viewpoint": None}
        there = Scene(
            cloud=Cloud(points, normals),
            points_in_cloud=points,
            point_of_row=none,
            approach_allowed=some,
            contact_allowed=some,
            **shared,  # type: ignore[arg-type]
        )
        here = DeviceScene(
            cloud=DeviceCloud(torch.from_numpy(points), torch.from_numpy(normals)),
            points_in_cloud=torch.from_numpy(points),
            approach_allowed=torch.from_numpy(some),
            contact_allowed=torch.from_numpy(some),
            at_side=None,
            **shared,  # type: ignore[arg-type]
        )
        for name in ("panda", "robotiq-2f-85"):
            hand = load_gripper(name)
            hit = collision.collides(there, poses, hand, asked)
            assert 0 < hit.sum() < len(hit)
            np.testing.assert_array_equal(hit, device_collision.collides(here, tensor, hand, asked))
            np.testing.assert_allclose(
                collision.clearances(there, poses, hand),
                device_collision.nearest_things(here, tensor, hand),
                atol=1e-6,
            )


@pytest.mark.parametrize("block", [7, 256])
@pytest.mark.parametrize("top_k", [1, 20, 1000])
def test_suppression(block: int, top_k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_selection, "BLOCK", block)
    poses = np.concatenate([hands(60), hands(60), hands(60) @ np.diag([-1, -1, 1, 1])])
    poses = poses.astype(np.float32)
    poses[60:, :3, 3] += np.random.default_rng(8).normal(0, 0.004, (120, 3))
    order = np.random.default_rng(9).permutation(180)[:170]
    asked = Suppression(translation=0.012, rotation=0.4)
    kept, dropped = ranking.suppress(poses, order, asked, top_k)
    found, lost = device_selection.suppress(torch.from_numpy(poses), order, asked, top_k)
    np.testing.assert_array_equal(kept, found)
    assert set(dropped.tolist()) == set(lost.tolist())
    assert len(kept) == min(top_k, len(kept))
    assert len(dropped) > 0
