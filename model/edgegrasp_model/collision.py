"""Where the hand would hit the cloud, and how far its fingers must open."""

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.gripper import Gripper
from edgegrasp_model.hand_description import APPROACH_LENGTH, HandView

FINGER_CLEARANCE = 0.005  # metres left free between each finger and the object


def collides(view: HandView, gripper: Gripper) -> NDArray[np.bool_]:
    """Which open hands meet a point of the cloud at the grasp or on the straight way to it.

    Args:
        view: The cloud from the hands of E candidates.
        gripper: Its boxes, fingers open to the maximum.

    Returns:
        (E,)
    """
    hit = np.zeros(len(view.candidate), dtype=bool)
    for low, high in gripper.boxes(gripper.max_opening):
        swept = low - np.array([0.0, 0.0, APPROACH_LENGTH])
        hit |= ((view.position > swept) & (view.position < high)).all(axis=1)
    result = np.zeros(view.num_candidates, dtype=bool)
    result[view.candidate[hit]] = True
    return result


def widths_needed(view: HandView, gripper: Gripper) -> NDArray[np.float32]:
    """Opening that lets the fingers pass what lies between them.

    Returns:
        (E,) metres, at most the gripper's maximum.
    """
    half = gripper.pad_half_width
    x, y, z = view.position.T
    inner = gripper.max_opening / 2
    ahead = (z > gripper.palm_z) & (z < gripper.foremost_z)
    between = (np.abs(x) < half) & (np.abs(y) < inner) & ahead
    reach = np.zeros(view.num_candidates, dtype=np.float32)
    np.maximum.at(reach, view.candidate[between], np.abs(y[between]))
    width: NDArray[np.float32] = np.minimum(2 * (reach + FINGER_CLEARANCE), gripper.max_opening)
    return width
