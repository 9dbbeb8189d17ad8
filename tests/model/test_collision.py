"""What the open hand hits; PyBullet, which knows nothing of ours, has to agree."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.collision import (
    clearances,
    collides,
    hits_cloud,
)
from edgegrasp_model.hand_view import APPROACH_LENGTH
from edgegrasp_model.options import Collision, OrientedBox, SupportPlane
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.scene import Scene

from .scenes import PANDA, scene_of

HAND = np.eye(4, dtype=np.float32)[None]
POSES = 600
DOUBT = 0.0005  # metres around touching in which neither is held to be right
DOT = 0.0005  # radius of the spheres that stand for points, metres
FLOOR = -0.08  # height of the support plane, metres
POINTS = np.random.default_rng(1).uniform(-0.06, 0.06, (25, 3)).astype(np.float32)
WALL = OrientedBox(
    center=(0.1, 0.05, 0.0),
    half_extents=(0.02, 0.06, 0.05),
    quaternion=tuple(Rotation.from_euler("xyz", [0.3, -0.4, 0.7]).as_quat().tolist()),
)


def cloud_of(*points: tuple[float, float, float]) -> Cloud:
    return Cloud(np.array(points, np.float32), np.zeros((len(points), 3), np.float32))


@pytest.mark.parametrize(
    ("point", "hits"),
    [
        ((0.0, 0.0, 0.10), False),  # between the fingers
        ((0.0, 0.05, 0.10), True),  # in a finger
        ((0.0, -0.05, 0.10), True),  # in the other
        ((0.0, 0.05, 0.12), False),  # ahead of the tips
        ((0.02, 0.05, 0.10), False),  # beside a finger
        ((0.0, 0.0, 0.06), True),  # in the palm
        ((0.0, 0.1, 0.0), True),  # in the hand
        ((0.0, 0.1, -0.05), True),  # where the hand passes on its way
        ((0.0, 0.1, -0.026 - APPROACH_LENGTH - 0.001), False),  # before it starts
        ((0.0, 0.07, 0.08), False),  # outside of a finger
    ],
)
def test_a_point_hits_the_hand_or_its_way(point: tuple[float, float, float], hits: bool) -> None:
    assert hits_cloud(cloud_of(point), HAND, PANDA, Collision()).tolist() == [hits]


def scene() -> Scene:
    obstacles = SolidBoxes.from_shapes([WALL], CanonicalFrame(np.eye(4)))
    support = SupportPlane(normal=(0.0, 0.0, 1.0), offset=FLOOR)
    return scene_of(POINTS, support=support, obstacles=obstacles)


def hands_about_the_points(count: int, seed: int) -> np.ndarray:
    """Hands (count, 4, 4) whose fingertips are about the points, half of them from above."""
    rng = np.random.default_rng(seed)
    hands = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    leaning = Rotation.from_euler("x", np.pi + rng.uniform(-0.5, 0.5, (count, 1)))
    hands[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    hands[::2, :3, :3] = leaning[::2].as_matrix()
    ahead = rng.uniform(0.06, 0.22, count)[:, None]
    hands[:, :3, 3] = rng.uniform(-0.07, 0.07, (count, 3)) - ahead * hands[:, :3, 2]
    return hands


class BulletScene:
    """The open hand, points, wall and floor in a physics world of their own."""

    def __init__(self) -> None:
        bullet = pytest.importorskip("pybullet")
        clients = pytest.importorskip("pybullet_utils.bullet_client")
        self.world = clients.BulletClient(bullet.DIRECT)
        self.hand = [
            self.box((high - low) / 2, shift=(high + low) / 2)
            for low, high in PANDA.boxes(PANDA.max_opening)
        ]
        dot = self.world.createCollisionShape(bullet.GEOM_SPHERE, radius=DOT)
        self.dots = [self.world.createMultiBody(0, dot, -1, point.tolist()) for point in POINTS]
        wall = self.box(WALL.half_extents)
        self.world.resetBasePositionAndOrientation(wall, WALL.center, WALL.quaternion)
        floor = self.box((1, 1, 0.2))
        self.world.resetBasePositionAndOrientation(floor, (0, 0, FLOOR - 0.2), (0, 0, 0, 1))
        self.others = [*self.dots, wall, floor]

    def box(self, half: object, shift: object = (0, 0, 0)) -> int:
        shape = self.world.createCollisionShape(
            self.world.GEOM_BOX, halfExtents=list(half), collisionFramePosition=list(shift)
        )
        return self.world.createMultiBody(0, shape)

    def distance(self, T_world_hand: np.ndarray, within: float) -> float:
        """Signed distance of the hand to the nearest surface, at most `within`."""
        quaternion = Rotation.from_matrix(T_world_hand[:3, :3]).as_quat()
        found = [within]
        for part in self.hand:
            self.world.resetBasePositionAndOrientation(part, T_world_hand[:3, 3], quaternion)
            for other in self.others:
                grown = DOT if other in self.dots else 0.0
                near = self.world.getClosestPoints(part, other, within)
                found += [contact[8] + grown for contact in near]
        return min(found)


@pytest.fixture(scope="module")
def bullet_scene() -> BulletScene:
    return BulletScene()


@pytest.mark.parametrize(
    ("camera", "blocked"),
    [((-0.6, 0.0, 0.0), True), ((0.6, 0.0, 0.0), False), (None, False)],
    ids=["in front of the plate", "behind it, with the hand", "unknown"],
)
def test_a_palm_in_space_that_no_camera_saw_counts_as_colliding(camera, blocked) -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.004), np.arange(-0.2, 0.3, 0.004))
    plate = np.stack([np.full_like(y, -0.1), y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    viewpoints = None if camera is None else np.array([camera], dtype=np.float32)
    behind = scene_of(plate, viewpoints=viewpoints)
    assert collides(behind, HAND, PANDA, Collision()).tolist() == [blocked]


@pytest.mark.parametrize("margin", [0.0, 0.004])
def test_hands_at_rest_collide_where_bullet_says_so(bullet_scene, margin) -> None:
    hands = hands_about_the_points(POSES, seed=2)
    found = collides(scene(), hands, PANDA, Collision(approach_length=0.0, margin=margin))
    measured = clearances(scene(), hands, PANDA)
    distance = np.array([bullet_scene.distance(hand, 0.02) for hand in hands])
    # Boxes grown on every side reach further at their edges than a distance does.
    clear = (distance < margin - DOUBT) | (distance > np.sqrt(3) * margin + DOUBT)
    assert clear.sum() > 0.7 * POSES
    assert 0.1 < found.mean() < 0.9
    assert (found[clear] == (distance[clear] < margin)).mean() >= 0.99
    apart = (distance > DOUBT) & (distance < 0.02 - DOUBT)
    # Bullet rounds the corners of boxes, by up to a millimetre.
    np.testing.assert_allclose(measured[apart], distance[apart], atol=0.0015)
    assert ((measured <= 0) == (distance <= 0))[np.abs(distance) > DOUBT].mean() >= 0.99
