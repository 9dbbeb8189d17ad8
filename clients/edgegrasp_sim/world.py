"""PyBullet, wrapped once: a world with its bodies, joints and constraints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
import pybullet

from edgegrasp_sim.poses import Matrix, quaternion_xyzw

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from types import TracebackType

TIME_STEP = 1.0 / 80.0  # seconds
SOLVER_ITERATIONS = 100
GRAVITY = 9.81  # m/s²


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
    """One physics server; every call names it, so that several can live in one process.

    Args:
        gui: open PyBullet's window instead of running without a display.

    Raises:
        RuntimeError: PyBullet could not start a server (no display for the window, or no
            free server left in this process).
    """

    def __init__(self, *, gui: bool = False) -> None:
        self.on_step: Callable[[], None] | None = None  # called after every time step
        self.client: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self.client < 0:
            raise RuntimeError("PyBullet did not start a physics server; close unused worlds")
        self.reset()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
            if self.on_step is not None:
                self.on_step()

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
    ) -> Body:
        """Load a body from a URDF file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: PyBullet cannot read it.
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
        self, size: Sequence[float], centre: Sequence[float], *, lateral_friction: float
    ) -> Body:
        """Add an axis-aligned box that never moves; `size` is its full extent in metres."""
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.5 * extent for extent in size],
            physicsClientId=self.client,
        )
        uid = pybullet.createMultiBody(0.0, shape, -1, centre, physicsClientId=self.client)
        body = Body(self.client, uid)
        body.change_dynamics(lateralFriction=lateral_friction)
        return body


class Body:
    """One body of a world. Its pose is that of its centre of mass."""

    def __init__(self, client: int, uid: int) -> None:
        self.client = client
        self.uid = uid

    def remove(self) -> None:
        """Take the body out of its world."""
        pybullet.removeBody(self.uid, physicsClientId=self.client)

    def change_dynamics(self, link: int = -1, **values: float) -> None:
        """Set mass, friction and the like of one link (-1: the base)."""
        pybullet.changeDynamics(self.uid, link, physicsClientId=self.client, **values)

    @property
    def position(self) -> Matrix:
        """Centre of mass of the base, world frame, metres: (3,)."""
        return np.asarray(self._pose()[0], dtype=np.float64)

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """Orientation of the base in the world."""
        return self._pose()[1]

    def set_pose(
        self, position: Sequence[float] | Matrix, quaternion_xyzw: Sequence[float]
    ) -> None:
        """Put the base's centre of mass there, at rest."""
        pybullet.resetBasePositionAndOrientation(
            self.uid, position, quaternion_xyzw, physicsClientId=self.client
        )

    def set_transform(self, T_world_com: Matrix) -> None:
        """Put the base's centre-of-mass frame there, at rest."""
        self.set_pose(T_world_com[:3, 3], quaternion_xyzw(T_world_com))

    def paint(self, colour: str) -> None:
        """Give every link a colour, `#rrggbb`; seen by people only, depth stays the same."""
        rgba = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)] + [1.0]
        links = pybullet.getNumJoints(self.uid, physicsClientId=self.client)
        for link in range(-1, links):
            pybullet.changeVisualShape(self.uid, link, rgbaColor=rgba, physicsClientId=self.client)

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

    def joint(self, index: int) -> Joint:
        """The joint that carries link `index`."""
        return Joint(self, index)

    def _pose(self) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
        position, quaternion = pybullet.getBasePositionAndOrientation(
            self.uid, physicsClientId=self.client
        )
        return position, quaternion


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
