"""The hands that execute grasps: the Panda's, a gripper file's, or a random one per scene."""

from typing import Any

import numpy as np

from edgegrasp_model.gripper import gripper_fields

PANDA, RANDOM = "panda", "random"
OPENING = 0.04, 0.14  # metres, as the other ranges
LENGTH = 0.035, 0.12  # of the fingers, from the palm to their tips
HALF_WIDTH = 0.005, 0.015  # of a finger
THICKNESS = 0.006, 0.022  # of a finger at its tip
ROOT = 0.0, 0.016  # further outward where it is thickest
PALM_Z = 0.06, 0.09
BODY = 0.02, 0.035  # half depth of the hand
INSIDE = 0.007  # from a contact to the fingertips, as in every gripper file
SWING_SHARE = 0.4  # of the hands, whose fingers swing
RADIUS = 0.05, 0.11  # of the link that carries such a finger
REACH = 0.6, 1.0  # outward part of that link in the open hand, in halves of the opening
STEEPEST = 0.75  # most of it, in radii


def hand_of_scene(name: str, rng: np.random.Generator) -> dict[str, Any] | None:
    """The fields of a gripper, by name or file, or random; None for the Panda."""
    if name == RANDOM:
        return random_gripper(rng)
    return None if name == PANDA else gripper_fields(name)


def random_gripper(rng: np.random.Generator) -> dict[str, Any]:
    """The fields of a gripper whose opening, and fingers' length, width and thickness are drawn.

    A finger is a pad, and behind it a root that is no thinner.
    """
    opening, length, half, thick = (
        round(rng.uniform(*span), 4) for span in (OPENING, LENGTH, HALF_WIDTH, THICKNESS)
    )
    palm, body, root = (round(rng.uniform(*span), 4) for span in (PALM_Z, BODY, ROOT))
    tip, pad = palm + length, palm + length * rng.uniform(0.2, 0.6)
    side = max(opening / 2 + thick + rng.uniform(-0.03, 0.02), 0.03)
    swing = None
    if rng.random() < SWING_SHARE:
        radius = rng.uniform(*RADIUS)
        reach = min(rng.uniform(*REACH) * opening / 2, STEEPEST * radius)
        swing = {"radius": radius, "reach": reach}
    return {
        "name": RANDOM,
        "max_opening": opening,
        "tip_z": tip,
        "contact_z": tip - INSIDE,
        "tcp_z": tip - INSIDE,
        "hand": {"boxes": [[[-body, -side, 0.0], [body, side, palm]]]},
        "finger": {
            "boxes": [
                [[-half, 0.0, pad], [half, thick, tip]],
                [[-half, 0.002, palm - 0.005], [half, thick + root, pad]],
            ]
        },
        "swing": swing,
    }
