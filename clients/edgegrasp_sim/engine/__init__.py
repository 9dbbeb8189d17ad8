"""The physics engine behind one interface: a world, its bodies, a hand and depth images.

Two engines implement it, a file each; nothing else knows which one runs.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edgegrasp_sim.poses import Matrix

Vector: TypeAlias = Sequence[float] | Matrix

TIME_STEP = 1.0 / 80.0  # seconds
GRAVITY = 9.81  # m/s²
OBJECT_MASS = 0.5  # kg
OBJECT_FRICTION = 1.0
SLIDE_MASS = 0.05  # kg, of what carries fingers that swing
ENGINES = ("pybullet", "mujoco")  # the first that is installed is the default


def choose_engine(asked: str | None = None, protocol: str = "") -> str:
    """The engine asked for, else the protocol's if installed, else any that is installed.

    Raises:
        ValueError: There is no engine of that name.
        ModuleNotFoundError: It is not installed, or none is.
    """
    for name in filter(None, (asked, protocol)):
        if name not in ENGINES:
            raise ValueError(f"engine is {name!r}; choose one of {', '.join(ENGINES)}")
    if asked and not installed(asked):
        raise ModuleNotFoundError(f"engine {asked} is not installed: pip install {asked}")
    for name in filter(None, (asked, protocol, *ENGINES)):
        if installed(name):
            return name
    raise ModuleNotFoundError("no physics engine is installed: pip install 'edgegrasp[sim]'")


def installed(engine: str) -> bool:
    """Whether an engine can be used here."""
    return importlib.util.find_spec(engine) is not None


def make_world(engine: str | None = None) -> "World":
    """An empty world of an engine, see `choose_engine` for the default and errors."""
    return world_type(choose_engine(engine))()


def world_type(engine: str) -> "type[World]":
    """The worlds of an engine."""
    if engine == "mujoco":
        from edgegrasp_sim.engine.with_mujoco import MujocoWorld

        return MujocoWorld
    from edgegrasp_sim.engine.with_pybullet import PybulletWorld

    return PybulletWorld


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


class Contact(NamedTuple):
    """One contact point of a body."""

    other_uid: int  # the body that is touched
    distance: float  # metres; negative where the two overlap


Parts: TypeAlias = tuple[Matrix, ...]  # convex ones, each by its points, (P, 3) metres


@dataclass(frozen=True, slots=True)
class HandModel:
    """A floating hand with two coupled fingers that slide apart along y."""

    palm: Parts  # in the hand's frame
    fingers: tuple[Parts, Parts]  # that at y > 0 and the other, shut, each in its own frame
    finger_base: float  # metres along the hand's z to the fingers' frames
    finger_centre: tuple[float, float, float]  # of mass of the finger at y > 0, metres
    tip: float  # fingertips as they hold something, metres along z
    centre: tuple[float, float, float]  # the palm's centre of mass, hand frame, metres
    max_opening: float  # metres between the fingers
    mass: float = 0.5  # of the palm, kg
    friction: float = 1.0  # of the palm
    finger_mass: float = 0.1  # kg
    finger_friction: float = 0.75  # lateral
    finger_force: float = 20.0  # with which each finger closes and opens, N
    tool_force: float = 300.0  # with which the hand is moved at most, N
    # How far the fingers are ahead of where they are in the open hand, metres: the coefficients of
    # 1, q, ..., q^4, where q is half the opening; None: they never are.
    advance: tuple[float, ...] | None = None
    meshes: tuple[str, str] | None = None  # PyBullet's palm and finger; None: boxes


@dataclass(frozen=True, slots=True)
class ArmModel:
    """An arm that carries a hand; J joints."""

    urdf: str  # XML with absolute paths of meshes, without what is beyond the flange
    T_world_root: Matrix  # where its first link stands, (4, 4)
    flange: str  # link that the hand is on
    T_flange_hand: Matrix  # where the hand's frame is in the flange's, (4, 4)
    joint_names: Sequence[str]  # of the moving joints, J
    home: Matrix  # where they rest, (J,) radians or metres


class World(Protocol):
    """A physics world; a process may have several. Removed bodies cannot be restored."""

    name: ClassVar[str]  # of the engine
    constants: ClassVar[dict[str, float]]  # its own, for the record of a result
    collision_depth: ClassVar[float]  # metres; a finger sliding along an object overlaps it by less
    # How a hand is shaken while it holds an object: to either side and back, along x and y.
    shake_distance: ClassVar[float]  # metres to either side
    shake_step: ClassVar[float]  # metres in each time step

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release what it holds. Safe to call twice."""

    def reset(self) -> None:
        """Remove every body."""

    def step(self, steps: int = 1) -> None:
        """Advance the world by `steps` time steps of 1/80 s."""

    def first_hits(self, starts: Matrix, ends: Matrix) -> list[int]:
        """The body that each ray meets first, -1 for none; (R, 3) metres each, world frame."""

    def detect_collisions(self) -> None:
        """Refresh the contact points without advancing time."""

    def save_state(self) -> Any:
        """Keep the present state until `reset`; valid for the bodies that are there now."""

    def restore_state(self, state: Any) -> None:
        """Return to a saved state."""

    def load_urdf(
        self, path: Path, position: Vector, quaternion_xyzw: Vector, scale: float
    ) -> "Body":
        """Load an object with its link frame there; its inertia is that of its collision shape."""

    def add_box(self, size: Vector, centre: Vector, *, friction: float, yaw: float = 0.0) -> "Body":
        """Add a box that never moves, turned about z; `size` is its full extent in metres."""

    def add_hand(self, model: HandModel, position: Matrix) -> "Hand":
        """Add an open hand with its centre of mass there; a world may have one."""

    def add_arm(self, arm: ArmModel, model: HandModel) -> "Arm":
        """Add an arm at its home with an open hand; raises ValueError if the engine has no arms."""
        raise ValueError(f"engine is {self.name}; an arm takes mujoco")

    def render_depth(self, T_world_camera: Matrix, camera: Intrinsics) -> NDArray[np.float64]:
        """Depth (height, width) at the pixels' lower left corners, metres; `far` if empty."""


class Body(Protocol):
    """One body of a world. Its pose is that of its centre of mass."""

    uid: int

    def remove(self) -> None:
        """Remove the body from its world."""

    @property
    def position(self) -> Matrix:
        """Centre of mass, world frame, metres: (3,)."""

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """Orientation in the world."""

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Set the pose of the centre of mass, at rest."""

    @property
    def speed(self) -> float:
        """Length of linear (m/s) and angular (rad/s) velocity taken together."""

    @property
    def bounds(self) -> Matrix:
        """Lowest and highest corner of the axis-aligned box around it: (2, 3) metres."""

    def contacts(self) -> list[Contact]:
        """The contact points found by the last step or collision detection."""


class Hand(Body, Protocol):
    """A hand: a body, its palm, that is moved with limited force, and two fingers."""

    @property
    def opening(self) -> float:
        """Metres between the fingers."""

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Set the hand's pose at once, open and at rest, and hold it there."""

    def move(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Pull the centre of mass there in the next step."""

    def close_fingers(self) -> None:
        """Drive the fingers together with full force from now on."""


class Arm(Hand, Protocol):
    """A hand on an arm: its joints move it, not its pose. Its contacts are those of all links."""

    substeps: ClassVar[int]  # of a time step

    def rest(self) -> None:
        """Move the arm to its home at once, at rest, with an open hand."""

    def drive(self, positions: Matrix, velocities: Matrix) -> None:
        """Have the joints' controllers follow (substeps, J) in the next time step."""
