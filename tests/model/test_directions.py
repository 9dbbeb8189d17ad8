import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgegrasp_model.candidates.sample import allowed_directions
from edgegrasp_model.options import ApproachDirection, Cone

DOWN, UP = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 0.0, 1.0])


def tilted(degrees: float) -> np.ndarray:
    """The way of a hand that moves down, tilted toward x."""
    angle = math.radians(degrees)
    return np.array([[math.sin(angle), 0.0, -math.cos(angle)]])


@pytest.mark.parametrize(
    ("request_", "angles", "allowed"),
    [
        (ApproachDirection(preset="top-down"), [0, 29, 31, 90, 180], [1, 1, 0, 0, 0]),
        (ApproachDirection(preset="side"), [0, 59, 61, 119, 121], [0, 0, 1, 1, 0]),
        # The direction is the way the hand moves: down, not where it comes from.
        (
            ApproachDirection(cones=(Cone(direction=(0, 0, -5), max_angle=0.2),)),
            [0, 11, 12, 180],
            [1, 1, 0, 0],
        ),
        (
            ApproachDirection(cones=(Cone(direction=(1, 0, 0), max_angle=0.1),), preset="top-down"),
            [0, 45, 90, 180],
            [1, 0, 1, 0],
        ),
        # Nothing asked for: not from more than 6 degrees below the horizontal.
        (None, [0, 90, 95, 97, 180], [1, 1, 1, 0, 0]),
    ],
)
def test_directions_are_ways_the_hand_moves(
    request_: ApproachDirection | None, angles: list[float], allowed: list[int]
) -> None:
    ways = np.concatenate([tilted(angle) for angle in angles])
    assert allowed_directions(ways, request_, UP).tolist() == [bool(value) for value in allowed]


def test_cones_are_given_in_the_frame_of_the_cloud_and_presets_by_up() -> None:
    turn = Rotation.from_euler("xyz", [1.0, 2.0, 3.0])
    cone = ApproachDirection(
        cones=(Cone(direction=tuple(turn.inv().apply([0, 0, -1])), max_angle=0.01),)
    )
    assert allowed_directions(DOWN, cone, UP, turn.apply).tolist() == [True]
    assert allowed_directions(DOWN, cone, UP).tolist() == [False]
    sideways = ApproachDirection(preset="side")
    assert allowed_directions(DOWN, sideways, [1.0, 0.0, 0.0]).tolist() == [True]
