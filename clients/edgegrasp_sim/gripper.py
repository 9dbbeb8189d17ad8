"""A floating Panda hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pybullet
import pybullet_data

from edgegrasp_sim.poses import Matrix, quaternion_xyzw, translation
from edgegrasp_sim.world import TIME_STEP, Body, WorldAnchor, couple_joints

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edgegrasp_sim.world import World

MAX_OPENING = 0.08  # metres between the fingers
FINGERTIP = 0.1122  # metres ahead of the link
# The centre of mass lies 0.04 m ahead of the panda_hand link; the engine moves bodies by it.
T_HAND_HANDCOM = translation(0.0, 0.0, 0.04)
T_HANDCOM_HAND = translation(0.0, 0.0, -0.04)

HAND_MASS = 0.5  # kg
HAND_FRICTION = 1.0
FINGER_MASS = 0.1  # kg
FINGER_FRICTION = 0.75
FINGER_SPINNING_FRICTION = 0.05
FINGER_STIFFNESS = 30000.0  # N/m at a contact
FINGER_DAMPING = 1000.0  # N s/m at a contact
FINGER_FORCE = 20.0  # N
FINGER_BASE = 0.0584  # metres ahead of the link
GEAR_FORCE = 30.0  # N
GEAR_ERP = 0.1
TOOL_FORCE = 300.0  # N
CLOSE_SECONDS = 0.5
COLLISION_DEPTH = 0.001  # metres; a finger that slides along what it grasps stays above it
# Far above the table and out of the camera's sight.
_PARKED = translation(0.15, 0.15, 5.0)


class Gripper:
    """The simulated hand; its link frame is `panda_hand` (z out of the palm, y closes).

    The shapes are the convex hulls of the Panda meshes in pybullet_data: palm at z = 0.0658,
    fingertips at z = 0.1122, hand within x ± 0.0316 and y ± 0.104.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.body = Body(world.client, _create_hand(world.client))
        self.body.change_dynamics(mass=HAND_MASS, lateralFriction=HAND_FRICTION)
        self.fingers = (self.body.joint(0), self.body.joint(1))
        for finger in self.fingers:
            self.body.change_dynamics(
                finger.index,
                lateralFriction=FINGER_FRICTION,
                spinningFriction=FINGER_SPINNING_FRICTION,
                contactStiffness=FINGER_STIFFNESS,
                contactDamping=FINGER_DAMPING,
                frictionAnchor=1,
                jointLowerLimit=0.0,
                jointUpperLimit=0.5 * MAX_OPENING,
            )
        self._anchor = WorldAnchor(self.body, _PARKED[:3, 3].tolist(), TOOL_FORCE)
        couple_joints(self.body, 0, 1, erp=GEAR_ERP, max_force=GEAR_FORCE)
        self.park()

    @property
    def opening(self) -> float:
        """Metres between the fingers."""
        return self.fingers[0].position + self.fingers[1].position

    def park(self) -> None:
        """Put the open hand where it touches nothing and no camera sees it."""
        self.place(_PARKED)

    def place(self, T_world_hand: Matrix) -> None:
        """Put the open hand there at once, at rest."""
        T_world_com = T_world_hand @ T_HAND_HANDCOM
        self.body.set_transform(T_world_com)
        self._anchor.move(T_world_com[:3, 3], quaternion_xyzw(T_world_com))
        for finger in self.fingers:
            finger.reset(0.5 * MAX_OPENING)
            finger.drive_to(0.5 * MAX_OPENING, FINGER_FORCE)

    def steps_to(self, T_world_hand: Matrix, *, step_length: float) -> Iterator[None]:
        """Drag the hand in a straight line, `step_length` metres in each time step.

        Yields:
            After every time step; a caller that stops asking leaves the hand where it is.
        """
        T_world_com = T_world_hand @ T_HAND_HANDCOM
        quaternion = quaternion_xyzw(T_world_com)
        position = self.body.position
        way = T_world_com[:3, 3] - position
        distance = float((way @ way) ** 0.5)
        steps = max(1, int(distance / step_length))
        for _ in range(steps):
            position = position + way / steps
            self._anchor.move(position, quaternion)
            self.world.step()
            yield

    def move_to(self, T_world_hand: Matrix, *, step_length: float) -> None:
        """Drag the hand all the way there, see `steps_to`."""
        for _ in self.steps_to(T_world_hand, step_length=step_length):
            pass

    def cuts_in(self) -> bool:
        """Whether the hand overlaps something by more than `COLLISION_DEPTH`."""
        return any(contact.distance < -COLLISION_DEPTH for contact in self.body.contacts())

    def closing_steps(self) -> Iterator[None]:
        """Close the fingers with full force for half a second; yields after every time step."""
        for finger in self.fingers:
            finger.drive_to(0.0, FINGER_FORCE)
        for _ in range(round(CLOSE_SECONDS / TIME_STEP)):
            self.world.step()
            yield


def _create_hand(client: int) -> int:
    """Build the hand with its two sliding fingers; returns the body's id."""
    meshes = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes" / "collision"
    half_turn = [0.0, 0.0, 1.0, 0.0]
    straight = [0.0, 0.0, 0.0, 1.0]

    def hull(file: str, quaternion: list[float]) -> int:
        return int(
            pybullet.createCollisionShape(
                pybullet.GEOM_MESH,
                fileName=str(meshes / file),
                collisionFrameOrientation=quaternion,
                physicsClientId=client,
            )
        )

    uid = pybullet.createMultiBody(
        baseMass=HAND_MASS,
        baseCollisionShapeIndex=hull("hand.obj", straight),
        basePosition=_PARKED[:3, 3].tolist(),
        baseInertialFramePosition=T_HAND_HANDCOM[:3, 3].tolist(),
        linkMasses=[FINGER_MASS] * 2,
        linkCollisionShapeIndices=[hull("finger.obj", straight), hull("finger.obj", half_turn)],
        linkVisualShapeIndices=[-1] * 2,
        linkPositions=[[0.0, 0.0, FINGER_BASE]] * 2,
        linkOrientations=[straight] * 2,
        linkInertialFramePositions=[[0.0, 0.01, 0.02], [0.0, -0.01, 0.02]],
        linkInertialFrameOrientations=[straight] * 2,
        linkParentIndices=[0] * 2,
        linkJointTypes=[pybullet.JOINT_PRISMATIC] * 2,
        linkJointAxis=[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
        physicsClientId=client,
    )
    return int(uid)
