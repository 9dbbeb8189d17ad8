"""The physics engine behind one interface: a world, its bodies, joints, constraints and images.

PyBullet is named in this file alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from edgegrasp_sim.poses import Matrix

TIME_STEP = 1.0 / 80.0  # seconds
SOLVER_ITERATIONS = 100
GRAVITY = 9.81  # m/s²
ASSETS = Path(pybullet_data.getDataPath())  # meshes and URDF files that come with the engine


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera; lengths in pixels, clipping distances in metres."""

    width: int = 640
    height: int = 480
    focal_length: float = 540.0
    centre_x: float = 320.0
    centre_y: float = 240.0
    near: float = 0.1
    far: float = 2.0


@dataclass(frozen=True, slots=True)
class Contact:
    """One contact point of a body.

    Attributes:
        other_uid: the body that is touched.
        distance: metres; negative where the two overlap.
    """

    other_uid: int
    distance: float


class World:
    """One physics server; a process may have several.

    Raises:
        RuntimeError: PyBullet could not start a server: none is left in this process.
    """

    def __init__(self) -> None:
        self.client: int = pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise RuntimeError("PyBullet did not start a physics server; close unused worlds")
        self.reset()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the physics server. Safe to call twice."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def reset(self) -> None:
        """Remove every body and set the engine's constants anew."""
        pybullet.resetSimulation(physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=SOLVER_ITERATIONS,
            # The order of contact pairs otherwise depends on what was loaded and moved before.
            deterministicOverlappingPairs=1,
            physicsClientId=self.client,
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)

    def step(self, steps: int = 1) -> None:
        """Advance the world by `steps` time steps of 1/80 s."""
        for _ in range(steps):
            pybullet.stepSimulation(physicsClientId=self.client)

    def first_hits(self, starts: Matrix, ends: Matrix) -> list[int]:
        """The body that each ray meets first, -1 for none; (R, 3) metres each, world frame."""
        hits = pybullet.rayTestBatch(starts.tolist(), ends.tolist(), physicsClientId=self.client)
        return [hit[0] for hit in hits]

    def detect_collisions(self) -> None:
        """Refresh the contact points without advancing time."""
        pybullet.performCollisionDetection(physicsClientId=self.client)

    def save_state(self) -> int:
        """Keep the present state in memory; valid until a body is added or removed."""
        return int(pybullet.saveState(physicsClientId=self.client))

    def restore_state(self, state: int) -> None:
        """Return to a kept state."""
        pybullet.restoreState(stateId=state, physicsClientId=self.client)

    def remove_state(self, state: int) -> None:
        """Forget a kept state."""
        pybullet.removeState(state, physicsClientId=self.client)

    def load_urdf(
        self, path: Path, position: Sequence[float], quaternion_xyzw: Sequence[float], scale: float
    ) -> "Body":
        """Load a body from a URDF file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the engine cannot read it.
        """
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
        return Body(self.client, uid)

    def add_box(
        self,
        size: Sequence[float],
        centre: Sequence[float],
        *,
        friction: float,
        yaw: float = 0.0,
    ) -> "Body":
        """Add a box that never moves, turned about z; `size` is its full extent in metres."""
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.5 * extent for extent in size],
            physicsClientId=self.client,
        )
        quaternion_xyzw = [0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))]
        uid = pybullet.createMultiBody(
            0.0, shape, -1, centre, quaternion_xyzw, physicsClientId=self.client
        )
        body = Body(self.client, uid)
        body.set_dynamics(friction=friction)
        return body

    def add_hand(
        self,
        palm: Path,
        finger: Path,
        *,
        palm_mass: float,
        palm_centre: Sequence[float],
        finger_mass: float,
        finger_base: float,
        position: Sequence[float],
    ) -> "Body":
        """Add a hand whose two fingers, its links 0 and 1, slide apart along y.

        Args:
            palm: mesh; the engine takes its convex hull.
            finger: mesh of the finger at y > 0; the other is it turned about z by half a turn.
            palm_mass: kg.
            palm_centre: centre of mass, hand frame, metres.
            finger_mass: kg.
            finger_base: metres along the hand's z to the fingers' frames.
            position: of the hand, world frame, metres.
        """
        straight, half_turn = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]
        palm_shape = self._hull(palm, straight)
        uid = pybullet.createMultiBody(
            baseMass=palm_mass,
            baseCollisionShapeIndex=palm_shape,
            basePosition=position,
            baseInertialFramePosition=palm_centre,
            linkMasses=[finger_mass] * 2,
            linkCollisionShapeIndices=[self._hull(finger, each) for each in (straight, half_turn)],
            linkVisualShapeIndices=[-1] * 2,
            linkPositions=[[0.0, 0.0, finger_base]] * 2,
            linkOrientations=[straight] * 2,
            linkInertialFramePositions=[[0.0, 0.01, 0.02], [0.0, -0.01, 0.02]],
            linkInertialFrameOrientations=[straight] * 2,
            linkParentIndices=[0] * 2,
            linkJointTypes=[pybullet.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]],
            physicsClientId=self.client,
        )
        return Body(self.client, int(uid))

    def render_depth(self, T_world_camera: Matrix, camera: Intrinsics) -> NDArray[np.float64]:
        """Distance along the line of sight for every pixel: (height, width) metres.

        Pixels that show nothing read `far`. A pixel is sampled at its lower left corner.
        """
        view = np.linalg.inv(T_world_camera)
        view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
        _, _, _, z_buffer, _ = pybullet.getCameraImage(
            camera.width,
            camera.height,
            viewMatrix=view.flatten(order="F").tolist(),
            projectionMatrix=_projection(camera).flatten(order="F").tolist(),
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.client,
        )
        z = np.asarray(z_buffer, dtype=np.float64).reshape(camera.height, camera.width)
        return camera.far * camera.near / (camera.far - (camera.far - camera.near) * z)

    def _hull(self, mesh: Path, quaternion_xyzw: Sequence[float]) -> int:
        """A collision shape: the convex hull of a mesh, turned."""
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            fileName=str(mesh),
            collisionFrameOrientation=quaternion_xyzw,
            physicsClientId=self.client,
        )
        return int(shape)


class Body:
    """One body of a world. Its pose is that of its centre of mass."""

    def __init__(self, client: int, uid: int) -> None:
        self.client = client
        self.uid = uid

    def remove(self) -> None:
        """Take the body out of its world."""
        pybullet.removeBody(self.uid, physicsClientId=self.client)

    def set_dynamics(self, *, friction: float, mass: float | None = None) -> None:
        """Set the base's friction and mass (kg).

        A given mass also makes the engine compute the inertia from the collision shape.
        """
        values = {} if mass is None else {"mass": mass}
        pybullet.changeDynamics(
            self.uid, -1, lateralFriction=friction, physicsClientId=self.client, **values
        )

    def set_finger(
        self,
        link: int,
        *,
        friction: float,
        spinning_friction: float,
        stiffness: float,
        damping: float,
        max_position: float,
    ) -> None:
        """Make a link a finger: soft contacts (N/m, N s/m), sliding from 0 to `max_position`."""
        pybullet.changeDynamics(
            self.uid,
            link,
            lateralFriction=friction,
            spinningFriction=spinning_friction,
            contactStiffness=stiffness,
            contactDamping=damping,
            frictionAnchor=1,
            jointLowerLimit=0.0,
            jointUpperLimit=max_position,
            physicsClientId=self.client,
        )

    @property
    def position(self) -> Matrix:
        """Centre of mass of the base, world frame, metres: (3,)."""
        pose = pybullet.getBasePositionAndOrientation(self.uid, physicsClientId=self.client)
        return np.asarray(pose[0], dtype=np.float64)

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """Orientation of the base in the world."""
        pose = pybullet.getBasePositionAndOrientation(self.uid, physicsClientId=self.client)
        x, y, z, w = pose[1]
        return x, y, z, w

    def set_pose(
        self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]
    ) -> None:
        """Put the base's centre of mass there, at rest."""
        pybullet.resetBasePositionAndOrientation(
            self.uid, position, quaternion_xyzw, physicsClientId=self.client
        )

    @property
    def speed(self) -> float:
        """Length of linear (m/s) and angular (rad/s) velocity taken together."""
        linear, angular = pybullet.getBaseVelocity(self.uid, physicsClientId=self.client)
        return float(np.linalg.norm((linear, angular)))

    @property
    def bounds(self) -> Matrix:
        """Lowest and highest corner of the axis-aligned box around the base: (2, 3) metres."""
        lower, upper = pybullet.getAABB(self.uid, physicsClientId=self.client)
        return np.asarray((lower, upper), dtype=np.float64)

    def contacts(self) -> list[Contact]:
        """The contact points found by the last step or collision detection."""
        points = pybullet.getContactPoints(self.uid, physicsClientId=self.client)
        return [Contact(other_uid=point[2], distance=point[8]) for point in points]


class Joint:
    """A joint with a position motor."""

    def __init__(self, body: Body, index: int) -> None:
        self.body = body
        self.index = index

    @property
    def position(self) -> float:
        """Joint position; metres for a sliding joint."""
        state = pybullet.getJointState(self.body.uid, self.index, physicsClientId=self.body.client)
        return float(state[0])

    def reset(self, position: float) -> None:
        """Put the joint there at once, at rest."""
        pybullet.resetJointState(
            self.body.uid, self.index, position, physicsClientId=self.body.client
        )

    def drive_to(self, position: float, force: float) -> None:
        """Let the motor pull toward `position` with at most `force` newtons."""
        pybullet.setJointMotorControl2(
            self.body.uid,
            self.index,
            pybullet.POSITION_CONTROL,
            targetPosition=position,
            force=force,
            physicsClientId=self.body.client,
        )


class WorldAnchor:
    """A fixed constraint that drags a body's centre-of-mass frame to a pose in the world."""

    def __init__(self, body: Body, position: Sequence[float], max_force: float) -> None:
        self.client = body.client
        self.max_force = max_force
        self.uid: int = pybullet.createConstraint(
            body.uid,
            -1,
            -1,
            -1,
            pybullet.JOINT_FIXED,
            [0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0],
            position,
            physicsClientId=self.client,
        )

    def move(self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]) -> None:
        """Set the pose to hold."""
        pybullet.changeConstraint(
            self.uid,
            jointChildPivot=position,
            jointChildFrameOrientation=quaternion_xyzw,
            maxForce=self.max_force,
            physicsClientId=self.client,
        )


def couple_joints(body: Body, first: int, second: int, *, erp: float, max_force: float) -> None:
    """Gear two joints of one body so that they move alike in opposite directions."""
    uid = pybullet.createConstraint(
        body.uid,
        first,
        body.uid,
        second,
        pybullet.JOINT_GEAR,
        [1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
        physicsClientId=body.client,
    )
    pybullet.changeConstraint(
        uid, gearRatio=-1.0, erp=erp, maxForce=max_force, physicsClientId=body.client
    )


def _projection(camera: Intrinsics) -> Matrix:
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
