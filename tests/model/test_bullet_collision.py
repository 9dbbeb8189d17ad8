"""The collision check agrees with PyBullet's, which knows nothing of ours."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.collision import clearances, collides
from edgegrasp_model.gripper import Gripper, load_gripper
from edgegrasp_model.options import Collision, OrientedBox, SupportPlane
from edgegrasp_model.scene.cloud import CanonicalFrame, Cloud
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.scene import Scene

bullet = pytest.importorskip("pybullet")

POSES = 2000
SWEPT_POSES = 150
DOUBT = 0.0005  # metres around touching in which neither is held to be right
DOT = 0.0005  # radius of the spheres that stand for points, metres
FLOOR = -0.08  # height of the support plane, metres

WALL = OrientedBox(
    center=(0.1, 0.05, 0.0),
    half_extents=(0.02, 0.06, 0.05),
    quaternion=tuple(Rotation.from_euler("xyz", [0.3, -0.4, 0.7]).as_quat().tolist()),
)
POINTS = np.random.default_rng(1).uniform(-0.06, 0.06, (25, 3)).astype(np.float32)


def scene() -> Scene:
    everywhere = np.ones(len(POINTS), dtype=bool)
    frame = CanonicalFrame(np.eye(4))
    return Scene(
        frame,
        Cloud(POINTS, POINTS),
        POINTS,
        np.arange(len(POINTS)),
        everywhere,
        everywhere,
        SupportPlane(normal=(0.0, 0.0, 1.0), offset=FLOOR),
        SolidBoxes.from_shapes([WALL], frame),
    )


def random_hands(count: int, seed: int) -> np.ndarray:
    """Hands (count, 4, 4) whose fingertips are about the points, half of them from above."""
    rng = np.random.default_rng(seed)
    hands = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    turns = Rotation.random(count, rng=rng)
    leaning = Rotation.from_euler("x", np.pi + rng.uniform(-0.5, 0.5, (count, 1)))
    hands[:, :3, :3] = turns.as_matrix()
    hands[::2, :3, :3] = leaning[::2].as_matrix()
    ahead = rng.uniform(0.06, 0.22, count)[:, None]
    hands[:, :3, 3] = rng.uniform(-0.07, 0.07, (count, 3)) - ahead * hands[:, :3, 2]
    return hands


class BulletHand:
    """The open hand, points, wall and floor in a physics world of their own."""

    def __init__(self, gripper: Gripper) -> None:
        self.client = bullet.connect(bullet.DIRECT)
        self.hand = [
            self.body(
                bullet.createCollisionShape(
                    bullet.GEOM_BOX,
                    halfExtents=((high - low) / 2).tolist(),
                    collisionFramePosition=((high + low) / 2).tolist(),
                    physicsClientId=self.client,
                )
            )
            for low, high in gripper.boxes(gripper.max_opening)
        ]
        dot = bullet.createCollisionShape(
            bullet.GEOM_SPHERE, radius=DOT, physicsClientId=self.client
        )
        self.others = [self.body(dot, point.tolist()) for point in POINTS]
        wall = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=WALL.half_extents, physicsClientId=self.client
        )
        self.others.append(self.body(wall, WALL.center, WALL.quaternion))
        floor = bullet.createCollisionShape(
            bullet.GEOM_BOX, halfExtents=[1, 1, 0.2], physicsClientId=self.client
        )
        self.others.append(self.body(floor, (0, 0, FLOOR - 0.2)))

    def body(self, shape: int, position=(0, 0, 0), quaternion=(0, 0, 0, 1)) -> int:
        return bullet.createMultiBody(
            0, shape, -1, position, quaternion, physicsClientId=self.client
        )

    def distance(self, T_world_hand: np.ndarray, within: float) -> float:
        """Signed distance of the hand to the nearest thing, at most `within`."""
        quaternion = Rotation.from_matrix(T_world_hand[:3, :3]).as_quat()
        found = [within]
        for part in self.hand:
            bullet.resetBasePositionAndOrientation(
                part, T_world_hand[:3, 3], quaternion, physicsClientId=self.client
            )
            for other in self.others:
                near = bullet.getClosestPoints(part, other, within, physicsClientId=self.client)
                grown = DOT if other in self.others[:-2] else 0.0
                found += [contact[8] + grown for contact in near]
        return min(found)


@pytest.fixture(scope="module")
def panda_in_bullet() -> Iterator[tuple[Gripper, BulletHand]]:
    gripper = load_gripper("panda")
    world = BulletHand(gripper)
    yield gripper, world
    bullet.disconnect(world.client)


def ours(hands: np.ndarray, gripper: Gripper, request: Collision) -> np.ndarray:
    here = scene()
    return collides(here, hands, gripper, request)


@pytest.mark.parametrize("margin", [0.0, 0.004])
def test_hands_at_rest_collide_where_bullet_says_so(
    panda_in_bullet: tuple[Gripper, BulletHand], margin: float
) -> None:
    gripper, world = panda_in_bullet
    hands = random_hands(POSES, seed=2)
    found = ours(hands, gripper, Collision(approach_length=0.0, margin=margin))
    measured = clearances(scene(), hands, gripper)
    distance = np.array([world.distance(hand, 0.02) for hand in hands])
    # Boxes grown on every side reach further at their edges than a distance does.
    clear = (distance < margin - DOUBT) | (distance > np.sqrt(3) * margin + DOUBT)
    assert clear.sum() > 0.7 * POSES
    assert 0.1 < found.mean() < 0.9
    agree = found[clear] == (distance[clear] < margin)
    assert agree.mean() >= 0.99
    apart = (distance > DOUBT) & (distance < 0.02 - DOUBT)
    # Bullet rounds the corners of boxes, by up to a millimetre.
    np.testing.assert_allclose(measured[apart], distance[apart], atol=0.0015)
    assert ((measured <= 0) == (distance <= 0))[np.abs(distance) > DOUBT].mean() >= 0.99


@pytest.mark.parametrize("direction", ["back", "up"])
def test_hands_on_their_way_collide_where_bullet_says_so(
    panda_in_bullet: tuple[Gripper, BulletHand], direction: str
) -> None:
    gripper, world = panda_in_bullet
    hands = random_hands(SWEPT_POSES, seed=3)
    request = Collision(approach_length=0.03, retreat_length=0.06, retreat_direction=direction)
    found = ours(hands, gripper, request)
    distance = np.full(SWEPT_POSES, np.inf)
    for row, hand in enumerate(hands):
        out = -hand[:3, 2] if direction == "back" else np.array([0, 0, 1])
        ways = [-hand[:3, 2] * step for step in np.linspace(0, 0.03, 11)]
        ways += [out * step for step in np.linspace(0, 0.06, 21)]
        for way in ways:
            moved = hand.copy()
            moved[:3, 3] += way
            distance[row] = min(distance[row], world.distance(moved, 0.01))
            if distance[row] < -DOUBT:
                break
    clear = np.abs(distance) > 0.0015  # half a step
    assert clear.sum() > 0.5 * SWEPT_POSES
    assert 0.05 < found.mean() < 0.95
    assert (found[clear] == (distance[clear] < 0)).mean() >= 0.99
