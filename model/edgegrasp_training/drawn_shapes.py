"""Shapes drawn at random: what a network learns from objects that nobody scanned.

A shape has closed parts, each a row of rings. The engine takes the convex hull of all of them, as
it does of scanned objects: many have hollows that can be seen but not entered.
"""

import numpy as np
from numpy.typing import NDArray

NUM_FREE, NUM_PLAIN = 320, 160
NUM_DRAWN = NUM_FREE + NUM_PLAIN  # different ones, before a scene stretches them
ROUND, FINE = 20, 32  # corners of a round ring
LONGEST = 0.045, 0.12  # metres, the range of the greatest extent
THINNEST = 0.009  # metres, least extent
PLAIN_WIDTH, PLAIN_HEIGHT = (0.03, 0.115), (0.03, 0.17)  # metres: some wider than a hand opens
Rings = NDArray[np.float64]  # (R, S, 3) corners of each ring along a part, any unit


def drawn_shape(index: int) -> str:
    """A shape as an OBJ file in metres, always the same for an index.

    Raises:
        IndexError: There are NUM_DRAWN.
    """
    if not 0 <= index < NUM_DRAWN:
        raise IndexError(f"drawn shape {index} of {NUM_DRAWN}")
    rng = np.random.default_rng([NUM_FREE, index])
    if index >= NUM_FREE:
        return as_obj([_plain(rng)])
    parts = _KINDS[index % len(_KINDS)](rng)
    extents = np.ptp(np.concatenate([part.reshape(-1, 3) for part in parts]), axis=0)
    scale = rng.uniform(*LONGEST) / extents.max()
    return as_obj([part * np.maximum(scale, THINNEST / extents) for part in parts])


def as_obj(parts: list[Rings]) -> str:
    """Parts as an OBJ file; neighbouring rings are joined, the end rings closed by fans."""
    lines: list[str] = []
    first = 1
    for rings in parts:
        points, faces = _surface(rings)
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + first]
        first += len(points)
    return "\n".join(lines) + "\n"


def _surface(rings: Rings) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (P, 3) and triangles (F, 3) that face outwards."""
    count, corners, _ = rings.shape
    ends = np.array([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    points = np.concatenate([rings.reshape(-1, 3), ends])
    this = np.arange(corners)
    beside = (this + 1) % corners
    faces = []
    for low in range(0, (count - 1) * corners, corners):
        high = low + corners
        faces += [np.stack([low + this, low + beside, high + beside], axis=1)]
        faces += [np.stack([low + this, high + beside, high + this], axis=1)]
    bottom, top = np.full(corners, count * corners), np.full(corners, count * corners + 1)
    last = (count - 1) * corners
    faces += [np.stack([bottom, beside, this], axis=1)]
    faces += [np.stack([top, last + this, last + beside], axis=1)]
    triangles = np.concatenate(faces)
    a, b, c = points[triangles].transpose(1, 0, 2)
    outwards = (np.cross(a, b) * c).sum() > 0.0
    return points, triangles if outwards else triangles[:, ::-1]


def _ring(corners: int, radii: NDArray[np.float64] | float = 1.0) -> NDArray[np.float64]:
    """(S, 3) a polygon about the z axis."""
    angle = 2.0 * np.pi * (np.arange(corners) + 0.5) / corners
    return np.stack([radii * np.cos(angle), radii * np.sin(angle), np.zeros(corners)], axis=1)


def _straight(ring: NDArray[np.float64], widths: list[float], heights: list[float]) -> Rings:
    """A ring moved along z to each height, as wide as said there."""
    return np.stack(
        [
            ring * (width, width, 1.0) + (0.0, 0.0, height)
            for width, height in zip(widths, heights, strict=True)
        ]
    )


def _body(rng: np.random.Generator) -> Rings:
    """A box, a prism, a cylinder, a frustum or an ellipsoid within two units."""
    corners = int(rng.choice([4, 4, 6, ROUND, ROUND]))
    ring = _ring(corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    if corners == ROUND and rng.random() < 0.3:
        angle = np.linspace(-0.49 * np.pi, 0.49 * np.pi, 9)
        return _straight(ring, list(np.cos(angle)), list(np.sin(angle)))
    taper = rng.uniform(0.4, 1.0) if rng.random() < 0.3 else 1.0
    return _straight(ring, [1.0, taper], [-1.0, 1.0])


def _plain(rng: np.random.Generator) -> Rings:
    """A box, a prism or a can, in metres: what stands on a shelf."""
    corners = int(rng.choice([4, 4, 6, FINE, FINE, FINE]))
    width, depth = rng.uniform(*PLAIN_WIDTH, size=2)
    half_height = rng.uniform(*PLAIN_HEIGHT) / 2.0
    ring = _ring(corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    ring = ring * (width / 2.0, (depth if corners == 4 else width) / 2.0, 1.0)
    top = rng.uniform(0.7, 1.0) if rng.random() < 0.3 else 1.0
    return _straight(ring, [1.0, top], [-half_height, half_height])


def _bodies(rng: np.random.Generator) -> list[Rings]:
    """Two to four bodies, each set on one before it: L, T, steps, a hammer, a mug's handle."""
    half = rng.uniform(0.25, 1.0, size=3)
    parts, boxes = [_body(rng) * half], [(np.zeros(3), half)]
    for _ in range(int(rng.integers(1, 4))):
        centre, size = boxes[int(rng.integers(len(boxes)))]
        half = rng.uniform(0.12, 0.8, size=3)
        axis, side = int(rng.integers(3)), float(rng.choice([-1.0, 1.0]))
        place = centre + rng.uniform(-0.6, 0.6, size=3) * size
        place[axis] = centre[axis] + side * (size[axis] + 0.85 * half[axis])
        turned = np.roll(_body(rng), int(rng.integers(3)), axis=2)
        parts.append(turned * half + place)
        boxes.append((place, half))
    return parts


def _bottle(rng: np.random.Generator) -> list[Rings]:
    """A body with a profile of its own: bottles, vases, spindles, dumb-bells."""
    rows = int(rng.integers(4, 9))
    widths = np.clip(0.5 + np.cumsum(rng.normal(0.0, 0.22, rows)), 0.15, 1.1)
    heights = np.sort(rng.uniform(-1.0, 1.0, rows)) * rng.uniform(0.6, 2.0)
    heights += 0.05 * np.arange(rows)  # no two at one height
    ring = _ring(int(rng.choice([4, 8, ROUND, ROUND]))) * (1.0, rng.uniform(0.5, 1.0), 1.0)
    return [_straight(ring, list(widths), list(heights))]


def _plate(rng: np.random.Generator) -> list[Rings]:
    """A flat thing with an outline that goes in and out."""
    corners = int(rng.choice([5, 8, 10, 16, 24]))
    if rng.random() < 0.5:
        radii = np.where(np.arange(corners) % 2, 1.0, rng.uniform(0.35, 0.9))
    else:
        radii = rng.uniform(0.4, 1.0, corners)
    ring = _ring(corners, radii) * (1.0, rng.uniform(0.4, 1.0), 1.0)
    height = rng.uniform(0.08, 0.45)
    return [_straight(ring, [1.0, rng.uniform(0.85, 1.0)], [0.0, height])]


def _bow(rng: np.random.Generator) -> list[Rings]:
    """A bent rod: bananas, horseshoes, handles."""
    turn = np.linspace(0.0, rng.uniform(np.pi / 3, 1.8 * np.pi), 16)
    taper = 1.0 - rng.uniform(0.0, 0.7) * np.abs(turn / turn[-1] - 0.5)
    ring = _ring(int(rng.choice([4, 8, 12]))) * (1.0, rng.uniform(0.5, 1.6), 1.0)
    return [_bent(ring, turn, rng.uniform(0.12, 0.45) * taper)]


def _hoop(rng: np.random.Generator) -> list[Rings]:
    """A bent rod that closes: rings, tapes, nuts, sleeves."""
    corners = int(rng.choice([4, 8, 12]))
    ring = _ring(corners) * (np.sqrt(2.0) if corners == 4 else 1.0)
    thick = rng.uniform(0.08, 0.48)
    height = np.exp(rng.uniform(np.log(0.4), np.log(4.0)))
    turn = np.linspace(0.0, 2.0 * np.pi, int(rng.choice([7, 9, 25, 25, 25])))
    return [_bent(ring * (1.0, height, 1.0), turn, np.full(len(turn), thick))]


def _pot(rng: np.random.Generator) -> list[Rings]:
    """Outside up, inside down again: cups, bowls, boxes without a lid."""
    corners = int(rng.choice([4, 6, ROUND, ROUND]))
    bottom, wall, floor = rng.uniform(0.5, 1.1), rng.uniform(0.06, 0.3), rng.uniform(0.08, 0.5)
    ring = _ring(corners) * (1.0, rng.uniform(0.5, 1.0), 1.0)
    height = rng.uniform(0.5, 2.5)
    inside = 1.0 - wall, max(bottom - wall, 0.1)
    heights = [0.0, height, height, floor * height]
    return [_straight(ring, [bottom, 1.0, *inside], heights)]


def _bent(
    ring: NDArray[np.float64], turn: NDArray[np.float64], thick: NDArray[np.float64]
) -> Rings:
    """A ring, so thick, led about the z axis at a distance of one unit."""
    radius = 1.0 + thick[:, None] * ring[:, 0]
    across = np.cos(turn)[:, None] * radius, np.sin(turn)[:, None] * radius
    return np.stack([*across, thick[:, None] * ring[:, 1]], axis=2)


_KINDS = (_bodies, _hoop, _bottle, _plate, _bodies, _pot, _bow, _hoop)
