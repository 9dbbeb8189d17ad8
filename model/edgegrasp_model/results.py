"""Outcomes and labels in an answer, and the minimum processor time of a detection."""

from enum import StrEnum
from typing import NamedTuple

OBSTACLE, SUPPORT, UNLABELLED = -1, -2, -3  # labels of rows of the cloud that belong to no object


class Outcome(StrEnum):
    """The outcome of a candidate."""

    RETURNED = "returned"
    DIRECTION = "direction"  # the hand would move in a direction that is not allowed
    SUPPORT = "support"  # it would go below the support plane
    NOT_CHECKED = "not-checked"  # dropped at random before the collision check
    COLLISION = "collision"  # the hand would hit the cloud, the support or an obstacle
    NOT_SCORED = "not-scored"  # near another candidate, or dropped at random to keep num_candidates
    LOW_SCORE = "low-score"  # below min_score
    SUPPRESSED = "suppressed"  # near a better one
    BEYOND_TOP_K = "beyond-top-k"


class NoGraspReason(StrEnum):
    """Why a given edge or hand pose defines no edge grasp."""

    NO_POINT = "no-point"  # one of its points was removed: workspace, support plane or outlier
    TOO_SHORT = "too-short"  # approach and contact point coincide
    TOO_LONG = "too-long"  # the contact lies beyond half the opening
    NO_DIRECTION = "no-direction"  # the edge runs along the normal
    TOO_DEEP = "too-deep"  # the contact lies deeper than the fingers are long
    NOTHING_BETWEEN = "nothing-between"  # the hand pose has no point between its fingers


class UngraspableReason(StrEnum):
    """Why an object has no good grasp."""

    TOO_WIDE = "too-wide"  # its visible part is wider than the hand opens, on all sides
    TOO_FLAT = "too-flat"  # most hands would cut into the support, or come from below
    BLOCKED = "blocked"  # every hand would hit something, or might hit something in unseen space
    HIDDEN = "hidden"  # no camera saw where it ends beyond the fingers


class Following(StrEnum):
    """The outcome of the first grasp of `previous`."""

    STARTED = "started"  # there was none
    KEPT = "kept"  # it is the first again, moved with its object
    REPLACED = "replaced"  # another one is better by a margin
    LOST = "lost"  # its object is not found again, or the hand no longer fits


class UnitCosts(NamedTuple):
    """Minimum processor time of a detection, seconds; 0 if it is not measured."""

    point: float = 0.0  # for each point of the cloud
    voxel: float = 0.0  # for each voxel in which grasps are searched
