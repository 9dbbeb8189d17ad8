"""The choice of a physics engine, and the types that both engines take and return.

Each engine is a module whose classes have the same methods: a world, its bodies, a hand.
`with_mujoco` has their docstrings. Other code does not depend on the engine.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from edgegrasp_camera.arrays import Float64

if TYPE_CHECKING:
    from edgegrasp_sim.engine.with_mujoco import MujocoBody, MujocoHand, MujocoWorld
    from edgegrasp_sim.engine.with_pybullet import PybulletBody, PybulletHand, PybulletWorld

World: TypeAlias = "MujocoWorld | PybulletWorld"
Body: TypeAlias = "MujocoBody | PybulletBody"
Hand: TypeAlias = "MujocoHand | PybulletHand"
Vector: TypeAlias = Sequence[float] | Float64

TIME_STEP = 1.0 / 80.0  # seconds
GRAVITY = 9.81  # m/s²
OBJECT_MASS = 0.5  # kg
OBJECT_FRICTION = 1.0
SLIDE_MASS = 0.05  # kg, of the carriage of swinging fingers
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
    for name in filter(None, (asked, protocol, *ENGINES)):
        if installed(name):
            return name
        if name == asked:
            raise ModuleNotFoundError(f"engine {asked} is not installed: pip install {asked}")
    raise ModuleNotFoundError("no physics engine is installed: pip install 'edgegrasp[sim]'")


def installed(engine: str) -> bool:
    """Whether an engine can be used here."""
    return importlib.util.find_spec(engine) is not None


def make_world(engine: str | None = None) -> World:
    """An empty world of an engine, see `choose_engine` for the default and errors."""
    return world_type(choose_engine(engine))()


def world_type(engine: str) -> type[World]:
    """The class of an engine's worlds."""
    module = importlib.import_module(f"edgegrasp_sim.engine.with_{engine}")
    found: type[World] = getattr(module, f"{engine.capitalize()}World")
    return found


@dataclass(frozen=True, slots=True)
class SimCamera:
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

    other_uid: int  # the other body
    distance: float  # metres; negative if the bodies overlap
    position: Sequence[float]  # (3,) world frame, metres


Parts: TypeAlias = tuple[Float64, ...]  # the points of each convex part, (P, 3) metres


@dataclass(frozen=True, slots=True)
class HandModel:
    """A floating hand with two coupled fingers that slide apart along y."""

    palm: Parts  # in the hand's frame
    fingers: tuple[Parts, Parts]  # at y > 0 and at y < 0, in the shut hand, each in its own frame
    finger_base: float  # metres along the hand's z to the fingers' frames
    finger_centre: tuple[float, float, float]  # of mass of the finger at y > 0, metres
    tip: float  # position of the fingertips along z when holding an object, metres
    centre: tuple[float, float, float]  # the palm's centre of mass, hand frame, metres
    max_opening: float  # metres between the fingers
    mass: float = 0.5  # of the palm, kg
    friction: float = 1.0  # of the palm
    finger_mass: float = 0.1  # kg
    finger_friction: float = 0.75  # lateral
    finger_force: float = 20.0  # of each finger when it closes or opens, N
    tool_force: float = 300.0  # maximum force that moves the hand, N
    # How far the fingers advance along z compared with the open hand, metres: the coefficients of
    # 1, q, ..., q^4, where q is half the opening; None: they do not advance.
    advance: tuple[float, ...] | None = None
    meshes: tuple[str, str] | None = None  # PyBullet's palm and finger; None: boxes


@dataclass(frozen=True, slots=True)
class ArmModel:
    """An arm that carries a hand; J joints."""

    urdf: str  # XML with absolute paths of meshes, without the links beyond the flange
    T_world_root: Float64  # pose of its first link, (4, 4)
    flange: str  # link that carries the hand
    T_flange_hand: Float64  # pose of the hand's frame in the flange's frame, (4, 4)
    joint_names: Sequence[str]  # of the moving joints, J
    home: Float64  # their positions at rest, (J,) radians or metres
