"""PyBullet, the engine of the published figures."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np
import pybullet
import pybullet_data
from pybullet_utils.bullet_client import BulletClient

from edgegrasp_camera.arrays import Float64, Int64
from edgegrasp_sim import engine
from edgegrasp_sim.engine import ArmModel, Contact, HandModel, Parts, SimCamera, Vector
from edgegrasp_sim.engine.urdf import read_urdf
from edgegrasp_sim.poses import about_z

SOLVER_ITERATIONS = 100
COLLISION_DEPTH = 0.001  # metres
FINGER_SPINNING_FRICTION = 0.05  # metres: ratio of torque about a contact's normal to its force
FINGER_STIFFNESS = 30000.0  # N/m at a contact
FINGER_DAMPING = 1000.0  # N s/m at a contact
GEAR_FORCE = 30.0  # N, of the gear that keeps both fingers at the same distance
GEAR_ERP = 0.1
# The Panda's collision meshes, with which the published figures were measured.
_MESHES = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes" / "collision"
_STRAIGHT, _HALF_TURN = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]  # xyzw


class PybulletWorld(AbstractContextManager["PybulletWorld"]):
    """One physics server; raises RuntimeError if none is left in this process."""

    name = "pybullet"
    constants: ClassVar = {
        "solver_iterations": SOLVER_ITERATIONS,
        "finger_spinning_friction": FINGER_SPINNING_FRICTION,
        "gear_force": GEAR_FORCE,
    }
    collision_depth = COLLISION_DEPTH
    shake_distance, shake_step = 0.05, 0.0125  # at 1 m/s the hand lags and moves half as far

    def __init__(self) -> None:
        self.client = BulletClient(pybullet.DIRECT)
        if not self.client.isConnected():
            raise RuntimeError("PyBullet did not start a physics server; close unused worlds")
        self.reset()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self.client.isConnected():
            self.client.disconnect()

    def reset(self) -> None:
        self.client.resetSimulation()
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=engine.TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            # The order of contact pairs otherwise depends on what was loaded and moved before.
            deterministicOverlappingPairs=1,
        )
        self.client.setGravity(0.0, 0.0, -engine.GRAVITY)
        self._hand: PybulletHand | None = None

    def step(self, steps: int = 1) -> None:
        for _ in range(steps):
            if self._hand is not None:
                self._hand.swing()
            self.client.stepSimulation()

    def first_hits(self, starts: Float64, ends: Float64) -> list[int]:
        return [hit[0] for hit in self.client.rayTestBatch(starts.tolist(), ends.tolist())]

    def detect_collisions(self) -> None:
        self.client.performCollisionDetection()

    def save_state(self) -> Any:
        return self.client.saveState()

    def restore_state(self, state: Any) -> None:
        self.client.restoreState(stateId=state)

    def load_urdf(
        self, path: Path, position: Vector, quaternion_xyzw: Vector, scale: float
    ) -> "PybulletBody":
        read_urdf(path, scale)  # raises for damaged files, which PyBullet accepts silently
        try:
            uid = self.client.loadURDF(str(path), position, quaternion_xyzw, globalScaling=scale)
        except pybullet.error as error:
            raise ValueError(f"PyBullet cannot read {path}: {error}") from error
        # A given mass also makes the engine compute the inertia from the collision shape.
        self.client.changeDynamics(
            uid, -1, lateralFriction=engine.OBJECT_FRICTION, mass=engine.OBJECT_MASS
        )
        return PybulletBody(self.client, uid)

    def add_box(
        self, size: Vector, centre: Vector, *, friction: float, yaw: float = 0.0
    ) -> "PybulletBody":
        shape = self.client.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=[0.5 * extent for extent in size]
        )
        uid = self.client.createMultiBody(0.0, shape, -1, centre, about_z(yaw))
        self.client.changeDynamics(uid, -1, lateralFriction=friction)
        return PybulletBody(self.client, uid)

    def add_hand(self, model: HandModel, position: Float64) -> "PybulletHand":
        self._hand = PybulletHand(self.client, model, position)
        return self._hand

    def add_arm(self, arm: ArmModel, model: HandModel) -> NoReturn:
        raise ValueError(f"engine is {self.name}; an arm takes mujoco")

    def render_depth(self, T_world_camera: Float64, camera: SimCamera) -> Float64:
        return self.render(T_world_camera, camera)[0]

    def render(self, T_world_camera: Float64, camera: SimCamera) -> tuple[Float64, Int64]:
        """Depth, and the body at each pixel, -1 for none."""
        view = np.linalg.inv(T_world_camera)
        view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
        near, far = camera.near, camera.far
        projection = np.zeros((4, 4))
        projection[0, 0] = 2.0 * camera.focal_length / camera.width
        projection[1, 1] = 2.0 * camera.focal_length / camera.height
        projection[0, 2] = 1.0 - 2.0 * camera.centre_x / camera.width
        projection[1, 2] = 2.0 * camera.centre_y / camera.height - 1.0
        projection[2, 2:] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
        projection[3, 2] = -1.0
        shape = camera.height, camera.width
        _, _, _, z_buffer, bodies = self.client.getCameraImage(
            camera.width,
            camera.height,
            viewMatrix=view.flatten(order="F").tolist(),
            projectionMatrix=projection.flatten(order="F").tolist(),
            renderer=pybullet.ER_TINY_RENDERER,
        )
        z = np.asarray(z_buffer, dtype=np.float64).reshape(shape)
        depth = far * near / (far - (far - near) * z)
        return depth, np.asarray(bodies, dtype=np.int64).reshape(shape)


class PybulletBody:
    """A body of a physics server."""

    def __init__(self, client: BulletClient, uid: int) -> None:
        self.client = client
        self.uid = uid

    def remove(self) -> None:
        self.client.removeBody(self.uid)

    @property
    def position(self) -> Float64:
        return np.asarray(self.client.getBasePositionAndOrientation(self.uid)[0], dtype=np.float64)

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        x, y, z, w = self.client.getBasePositionAndOrientation(self.uid)[1]
        return x, y, z, w

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        self.client.resetBasePositionAndOrientation(self.uid, position, quaternion_xyzw)

    @property
    def speed(self) -> float:
        linear, angular = self.client.getBaseVelocity(self.uid)
        return float(np.linalg.norm((linear, angular)))

    @property
    def bounds(self) -> Float64:
        return np.asarray(self.client.getAABB(self.uid), dtype=np.float64)

    def contacts(self) -> list[Contact]:
        points = self.client.getContactPoints(self.uid)
        return [Contact(other_uid=at[2], distance=at[8], position=at[6]) for at in points]


class PybulletHand(PybulletBody):
    """A hand that a fixed constraint pulls; the last two links are its fingers."""

    def __init__(self, client: BulletClient, model: HandModel, position: Float64) -> None:
        self.client, self.model = client, model
        if model.meshes is None:
            palm, *fingers = (_boxes(client, each) for each in (model.palm, *model.fingers))
        else:
            palm = _hull(client, model.meshes[0], _STRAIGHT)
            fingers = [_hull(client, model.meshes[1], each) for each in (_STRAIGHT, _HALF_TURN)]
        x, y, z = model.finger_centre
        ahead = 0 if model.advance is None else 1  # links before the fingers
        links = ahead + 2
        uid = self.client.createMultiBody(
            baseMass=model.mass,
            baseCollisionShapeIndex=palm,
            basePosition=position,
            baseInertialFramePosition=model.centre,
            linkMasses=[engine.SLIDE_MASS] * ahead + [model.finger_mass] * 2,
            linkCollisionShapeIndices=[-1] * ahead + fingers,
            linkVisualShapeIndices=[-1] * links,
            linkPositions=[[0.0, 0.0, 0.0]] * ahead + [[0.0, 0.0, model.finger_base]] * 2,
            linkOrientations=[_STRAIGHT] * links,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * ahead + [[x, y, z], [x, -y, z]],
            linkInertialFrameOrientations=[_STRAIGHT] * links,
            linkParentIndices=[0] * ahead + [ahead] * 2,
            linkJointTypes=[pybullet.JOINT_PRISMATIC] * links,
            linkJointAxis=[[0.0, 0.0, 1.0]] * ahead + [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
        )
        super().__init__(client, int(uid))
        self._fingers = ahead, ahead + 1
        client.changeDynamics(self.uid, -1, lateralFriction=model.friction, mass=model.mass)
        for finger in self._fingers:
            client.changeDynamics(
                self.uid,
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
        self._anchor = self.client.createConstraint(
            self.uid, -1, -1, -1, pybullet.JOINT_FIXED, none, none, position
        )
        one, other = self._fingers
        gear = self.client.createConstraint(
            self.uid, one, self.uid, other, pybullet.JOINT_GEAR, [1.0, 0.0, 0.0], none, none
        )
        self.client.changeConstraint(gear, gearRatio=-1.0, erp=GEAR_ERP, maxForce=GEAR_FORCE)

    @property
    def opening(self) -> float:
        states = self.client.getJointStates(self.uid, self._fingers)
        return float(states[0][0]) + float(states[1][0])

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        super().set_pose(position, quaternion_xyzw)
        self.move(position, quaternion_xyzw)
        half = 0.5 * self.model.max_opening
        if self.model.advance is not None:
            self.client.resetJointState(self.uid, 0, 0.0)
        for finger in self._fingers:
            self.client.resetJointState(self.uid, finger, half)
            self._drive(finger, half, self.model.finger_force)

    def move(self, position: Vector, quaternion_xyzw: Vector) -> None:
        self.client.changeConstraint(
            self._anchor,
            jointChildPivot=position,
            jointChildFrameOrientation=quaternion_xyzw,
            maxForce=self.model.tool_force,
        )

    def close_fingers(self) -> None:
        for finger in self._fingers:
            self._drive(finger, 0.0, self.model.finger_force)

    def swing(self) -> None:
        """Move swinging fingers along z in the next step, as their opening requires."""
        if self.model.advance is None:
            return
        finger = self.client.getJointState(self.uid, self._fingers[0])
        half = finger[0] + engine.TIME_STEP * finger[1]
        ahead = float(np.polynomial.polynomial.polyval(half, self.model.advance))
        self._drive(0, ahead, self.model.tool_force, positionGain=1.0)

    def _drive(self, link: int, position: float, force: float, **gain: float) -> None:
        """Drive a link's motor toward a position, metres."""
        mode, goal = pybullet.POSITION_CONTROL, {"targetPosition": position, "force": force}
        self.client.setJointMotorControl2(self.uid, link, mode, **goal, **gain)


def _hull(client: BulletClient, mesh: str, quaternion_xyzw: Vector) -> int:
    shape = client.createCollisionShape(
        pybullet.GEOM_MESH, fileName=str(_MESHES / mesh), collisionFrameOrientation=quaternion_xyzw
    )
    return int(shape)


def _boxes(client: BulletClient, parts: Parts) -> int:
    shape = client.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] * len(parts),
        halfExtents=[(np.ptp(part, axis=0) / 2).tolist() for part in parts],
        collisionFramePositions=[
            ((part.min(axis=0) + part.max(axis=0)) / 2).tolist() for part in parts
        ],
    )
    return int(shape)
