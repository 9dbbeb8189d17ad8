"""PyBullet, which the published figures were measured in."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from edgegrasp_sim.engine import (
    GRAVITY,
    SLIDE_MASS,
    TIME_STEP,
    Body,
    Contact,
    Hand,
    HandModel,
    Intrinsics,
    Parts,
    Shake,
    World,
)
from edgegrasp_sim.poses import Matrix

SOLVER_ITERATIONS = 100
COLLISION_DEPTH = 0.001  # metres
SHAKE = Shake(0.05, 0.0125)  # at 1 m/s: the hand lags and comes half as far
FINGER_SPINNING_FRICTION = 0.05  # metres: torque about a contact's normal, by its force
FINGER_STIFFNESS = 30000.0  # N/m at a contact
FINGER_DAMPING = 1000.0  # N s/m at a contact
GEAR_FORCE = 30.0  # N, which keeps the fingers at one opening
GEAR_ERP = 0.1
CONSTANTS = {
    "time_step": TIME_STEP,
    "solver_iterations": SOLVER_ITERATIONS,
    "gravity": GRAVITY,
    "collision_depth": COLLISION_DEPTH,
    "finger_spinning_friction": FINGER_SPINNING_FRICTION,
    "gear_force": GEAR_FORCE,
}
# The Panda's collision meshes, which the published figures were measured with.
_MESHES = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes" / "collision"
_STRAIGHT, _HALF_TURN = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]  # xyzw


class PybulletWorld(World):
    """One physics server.

    Raises:
        RuntimeError: PyBullet could not start a server: none is left in this process.
    """

    name = "pybullet"
    collision_depth = COLLISION_DEPTH
    shake = SHAKE

    def __init__(self) -> None:
        self.client: int = pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise RuntimeError("PyBullet did not start a physics server; close unused worlds")
        self.reset()

    def close(self) -> None:
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def reset(self) -> None:
        pybullet.resetSimulation(physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            # The order of contact pairs otherwise depends on what was loaded and moved before.
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        self._hand: PybulletHand | None = None

    def step(self, steps: int = 1) -> None:
        for _ in range(steps):
            if self._hand is not None:
                self._hand.swing()
            pybullet.stepSimulation(physicsClientId=self.client)

    def first_hits(self, starts: Matrix, ends: Matrix) -> list[int]:
        hits = pybullet.rayTestBatch(starts.tolist(), ends.tolist(), physicsClientId=self.client)
        return [hit[0] for hit in hits]

    def detect_collisions(self) -> None:
        pybullet.performCollisionDetection(physicsClientId=self.client)

    def save_state(self) -> int:
        return int(pybullet.saveState(physicsClientId=self.client))

    def restore_state(self, state: int) -> None:
        pybullet.restoreState(stateId=state, physicsClientId=self.client)

    def remove_state(self, state: int) -> None:
        pybullet.removeState(state, physicsClientId=self.client)

    def load_urdf(
        self,
        path: Path,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
        scale: float,
        *,
        mass: float,
        friction: float,
    ) -> "PybulletBody":
        if not path.is_file():
            raise FileNotFoundError(f"no object file at {path}; check the object folder")
        try:
            uid = pybullet.loadURDF(
                str(path),
                position,
                quaternion_xyzw,
                globalScaling=scale,
                physicsClientId=self.client,
            )
        except pybullet.error as error:
            raise ValueError(f"PyBullet cannot read {path}: {error}") from error
        body = PybulletBody(self.client, uid)
        # A given mass also makes the engine compute the inertia from the collision shape.
        body.change(-1, lateralFriction=friction, mass=mass)
        return body

    def add_box(
        self,
        size: Sequence[float],
        centre: Sequence[float],
        *,
        friction: float,
        yaw: float = 0.0,
    ) -> "PybulletBody":
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.5 * extent for extent in size],
            physicsClientId=self.client,
        )
        quaternion_xyzw = [0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))]
        uid = pybullet.createMultiBody(
            0.0, shape, -1, centre, quaternion_xyzw, physicsClientId=self.client
        )
        body = PybulletBody(self.client, uid)
        body.change(-1, lateralFriction=friction)
        return body

    def add_hand(self, model: HandModel, position: Matrix) -> "PybulletHand":
        self._hand = PybulletHand(self.client, model, position)
        return self._hand

    def render_depth(self, T_world_camera: Matrix, camera: Intrinsics) -> NDArray[np.float64]:
        view = np.linalg.inv(T_world_camera)
        view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
        _, _, _, z_buffer, _ = pybullet.getCameraImage(
            camera.width,
            camera.height,
            viewMatrix=view.flatten(order="F").tolist(),
            projectionMatrix=projection(camera).flatten(order="F").tolist(),
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.client,
        )
        z = np.asarray(z_buffer, dtype=np.float64).reshape(camera.height, camera.width)
        return camera.far * camera.near / (camera.far - (camera.far - camera.near) * z)


class PybulletBody(Body):
    """A body of a physics server."""

    def __init__(self, client: int, uid: int) -> None:
        self.client = client
        self.uid = uid

    def change(self, link: int, **dynamics: float) -> None:
        """Set properties of a link, -1 the base, by the engine's names for them."""
        pybullet.changeDynamics(self.uid, link, physicsClientId=self.client, **dynamics)

    def remove(self) -> None:
        pybullet.removeBody(self.uid, physicsClientId=self.client)

    @property
    def position(self) -> Matrix:
        pose = pybullet.getBasePositionAndOrientation(self.uid, physicsClientId=self.client)
        return np.asarray(pose[0], dtype=np.float64)

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        pose = pybullet.getBasePositionAndOrientation(self.uid, physicsClientId=self.client)
        x, y, z, w = pose[1]
        return x, y, z, w

    def set_pose(
        self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]
    ) -> None:
        pybullet.resetBasePositionAndOrientation(
            self.uid, position, quaternion_xyzw, physicsClientId=self.client
        )

    @property
    def speed(self) -> float:
        linear, angular = pybullet.getBaseVelocity(self.uid, physicsClientId=self.client)
        return float(np.linalg.norm((linear, angular)))

    @property
    def bounds(self) -> Matrix:
        lower, upper = pybullet.getAABB(self.uid, physicsClientId=self.client)
        return np.asarray((lower, upper), dtype=np.float64)

    def contacts(self) -> list[Contact]:
        points = pybullet.getContactPoints(self.uid, physicsClientId=self.client)
        return [Contact(other_uid=point[2], distance=point[8]) for point in points]


class PybulletHand(PybulletBody, Hand):
    """A hand whose last two links are its fingers; a fixed constraint drags its palm.

    Fingers that swing slide along y on a link that slides along z.
    """

    def __init__(self, client: int, model: HandModel, position: Matrix) -> None:
        self.model = model
        if model.meshes is None:
            palm, *fingers = (_boxes(client, each) for each in (model.palm, *model.fingers))
        else:
            palm = _hull(client, model.meshes[0], _STRAIGHT)
            fingers = [_hull(client, model.meshes[1], each) for each in (_STRAIGHT, _HALF_TURN)]
        x, y, z = model.finger_centre
        ahead = 0 if model.advance is None else 1  # links before the fingers
        links = ahead + 2
        uid = pybullet.createMultiBody(
            baseMass=model.mass,
            baseCollisionShapeIndex=palm,
            basePosition=position,
            baseInertialFramePosition=model.centre,
            linkMasses=[SLIDE_MASS] * ahead + [model.finger_mass] * 2,
            linkCollisionShapeIndices=[-1] * ahead + fingers,
            linkVisualShapeIndices=[-1] * links,
            linkPositions=[[0.0, 0.0, 0.0]] * ahead + [[0.0, 0.0, model.finger_base]] * 2,
            linkOrientations=[_STRAIGHT] * links,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * ahead + [[x, y, z], [x, -y, z]],
            linkInertialFrameOrientations=[_STRAIGHT] * links,
            linkParentIndices=[0] * ahead + [ahead] * 2,
            linkJointTypes=[pybullet.JOINT_PRISMATIC] * links,
            linkJointAxis=[[0.0, 0.0, 1.0]] * ahead + [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
            physicsClientId=client,
        )
        super().__init__(client, int(uid))
        self._fingers = ahead, ahead + 1
        self.change(-1, lateralFriction=model.friction, mass=model.mass)
        for finger in self._fingers:
            self.change(
                finger,
                lateralFriction=model.finger_friction,
                spinningFriction=FINGER_SPINNING_FRICTION,
                contactStiffness=FINGER_STIFFNESS,
                contactDamping=FINGER_DAMPING,
                frictionAnchor=1,
                jointLowerLimit=0.0,
                jointUpperLimit=0.5 * model.max_opening,
            )
        none = [0.0, 0.0, 0.0]
        self._anchor = pybullet.createConstraint(
            self.uid, -1, -1, -1, pybullet.JOINT_FIXED, none, none, position, physicsClientId=client
        )
        along = [1.0, 0.0, 0.0]
        gear = pybullet.createConstraint(
            self.uid,
            self._fingers[0],
            self.uid,
            self._fingers[1],
            pybullet.JOINT_GEAR,
            along,
            none,
            none,
            physicsClientId=client,
        )
        pybullet.changeConstraint(
            gear, gearRatio=-1.0, erp=GEAR_ERP, maxForce=GEAR_FORCE, physicsClientId=client
        )

    @property
    def opening(self) -> float:
        states = pybullet.getJointStates(self.uid, self._fingers, physicsClientId=self.client)
        return float(states[0][0]) + float(states[1][0])

    def set_pose(
        self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]
    ) -> None:
        super().set_pose(position, quaternion_xyzw)
        self.move(position, quaternion_xyzw)
        half = 0.5 * self.model.max_opening
        if self.model.advance is not None:
            pybullet.resetJointState(self.uid, 0, 0.0, physicsClientId=self.client)
        for finger in self._fingers:
            pybullet.resetJointState(self.uid, finger, half, physicsClientId=self.client)
            self._drive(finger, half)

    def move(self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]) -> None:
        pybullet.changeConstraint(
            self._anchor,
            jointChildPivot=position,
            jointChildFrameOrientation=quaternion_xyzw,
            maxForce=self.model.tool_force,
            physicsClientId=self.client,
        )

    def close_fingers(self) -> None:
        for finger in self._fingers:
            self._drive(finger, 0.0)

    def swing(self) -> None:
        """Have the fingers come forward in the next step as far as they will have closed."""
        if self.model.advance is None:
            return
        finger = pybullet.getJointState(self.uid, self._fingers[0], physicsClientId=self.client)
        half = finger[0] + TIME_STEP * finger[1]
        pybullet.setJointMotorControl2(
            self.uid,
            0,
            pybullet.POSITION_CONTROL,
            targetPosition=float(np.polynomial.polynomial.polyval(half, self.model.advance)),
            force=self.model.tool_force,
            positionGain=1.0,
            physicsClientId=self.client,
        )

    def _drive(self, finger: int, position: float) -> None:
        """Let a finger's motor pull toward a place, metres from the middle."""
        pybullet.setJointMotorControl2(
            self.uid,
            finger,
            pybullet.POSITION_CONTROL,
            targetPosition=position,
            force=self.model.finger_force,
            physicsClientId=self.client,
        )


def _hull(client: int, mesh: str, quaternion_xyzw: Sequence[float]) -> int:
    """A collision shape: the convex hull of a mesh, turned."""
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        fileName=str(_MESHES / mesh),
        collisionFrameOrientation=quaternion_xyzw,
        physicsClientId=client,
    )
    return int(shape)


def _boxes(client: int, parts: Parts) -> int:
    """A collision shape: the boxes around some parts."""
    shape = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] * len(parts),
        halfExtents=[(np.ptp(part, axis=0) / 2).tolist() for part in parts],
        collisionFramePositions=[
            ((part.min(axis=0) + part.max(axis=0)) / 2).tolist() for part in parts
        ],
        physicsClientId=client,
    )
    return int(shape)


def projection(camera: Intrinsics) -> Matrix:
    """OpenGL's projection matrix of a pinhole camera (row-major)."""
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 2.0 * camera.focal_length / camera.width
    matrix[1, 1] = 2.0 * camera.focal_length / camera.height
    matrix[0, 2] = 1.0 - 2.0 * camera.centre_x / camera.width
    matrix[1, 2] = 2.0 * camera.centre_y / camera.height - 1.0
    matrix[2, 2] = -(camera.far + camera.near) / (camera.far - camera.near)
    matrix[2, 3] = -2.0 * camera.far * camera.near / (camera.far - camera.near)
    matrix[3, 2] = -1.0
    return matrix
