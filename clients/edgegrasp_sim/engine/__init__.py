"""The physics engine behind one interface: a world, its bodies, a hand and depth images."""

from edgegrasp_sim.engine.with_pybullet import (
    ASSETS,
    GRAVITY,
    SOLVER_ITERATIONS,
    TIME_STEP,
    Body,
    Contact,
    Intrinsics,
    Joint,
    World,
    WorldAnchor,
    couple_joints,
)

__all__ = [
    "ASSETS",
    "GRAVITY",
    "SOLVER_ITERATIONS",
    "TIME_STEP",
    "Body",
    "Contact",
    "Intrinsics",
    "Joint",
    "World",
    "WorldAnchor",
    "couple_joints",
]
