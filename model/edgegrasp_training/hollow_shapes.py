"""Rings, tubes, bowls and cups: hollow things, which object sets hold few of."""

import numpy as np
from numpy.typing import NDArray

SEGMENTS = 24  # around the axis
AXIS = 1e-4  # metres; profiles keep off the axis, where triangles would have no area
Profile = NDArray[np.float64]  # (P, 2) radius and height, metres; closed, counter-clockwise


def _torus(radius: float, tube: float) -> Profile:
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    return np.stack([radius + tube * np.cos(angle), tube * np.sin(angle)], axis=1)


def _tube(outer: float, inner: float, height: float) -> Profile:
    return np.array([[inner, 0.0], [outer, 0.0], [outer, height], [inner, height]])


def _bowl(radius: float, depth: float, wall: float) -> Profile:
    angle = np.linspace(0.0, np.pi / 2, 8)
    outside = np.stack([radius * np.sin(angle), depth * (1.0 - np.cos(angle))], axis=1)
    inside = np.array([radius - wall, depth - wall]) * np.stack([np.sin(angle), -np.cos(angle)], 1)
    inside[:, 1] += depth
    profile: Profile = np.concatenate([outside, inside[::-1]])
    profile[:, 0] = np.maximum(profile[:, 0], AXIS)
    return profile


def _cup(bottom: float, top: float, height: float, wall: float) -> Profile:
    return np.array(
        [
            [AXIS, 0.0],
            [bottom, 0.0],
            [top, height],
            [top - wall, height],
            [bottom - wall, wall],
            [AXIS, wall],
        ]
    )


# Metres; a scene's own scale, and a stretch along each axis, come on top.
SHAPES: dict[str, Profile] = {
    "made-torus-slim": _torus(0.030, 0.006),
    "made-torus": _torus(0.026, 0.010),
    "made-torus-thick": _torus(0.024, 0.014),
    "made-torus-large": _torus(0.034, 0.011),
    "made-ring-flat": _tube(0.035, 0.020, 0.010),
    "made-ring": _tube(0.033, 0.022, 0.020),
    "made-ring-narrow": _tube(0.024, 0.010, 0.016),
    "made-tube": _tube(0.020, 0.015, 0.060),
    "made-tube-wide": _tube(0.030, 0.025, 0.045),
    "made-bowl": _bowl(0.038, 0.030, 0.004),
    "made-bowl-flat": _bowl(0.042, 0.018, 0.004),
    "made-bowl-deep": _bowl(0.030, 0.038, 0.005),
    "made-cup": _cup(0.020, 0.028, 0.060, 0.003),
    "made-cup-low": _cup(0.028, 0.034, 0.035, 0.004),
}


def revolved(profile: Profile) -> str:
    """The surface that a closed profile makes when turned about z, as an OBJ file."""
    angle = 2.0 * np.pi / SEGMENTS * np.arange(SEGMENTS)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring = profile[:, None, :1] * turn  # (P, S, 2)
    height = np.broadcast_to(profile[:, None, 1:], (len(profile), SEGMENTS, 1))
    points = np.concatenate([ring, height], axis=2).reshape(-1, 3)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    for row in range(len(profile)):
        this, following = row * SEGMENTS, (row + 1) % len(profile) * SEGMENTS
        for k in range(SEGMENTS):
            beside = (k + 1) % SEGMENTS
            a, b, c, d = this + k, this + beside, following + beside, following + k
            lines += [f"f {a + 1} {b + 1} {c + 1}", f"f {a + 1} {c + 1} {d + 1}"]
    return "\n".join(lines) + "\n"
