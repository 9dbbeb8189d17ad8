"""Household objects of random shape and size, as convex parts: cans to scissors.

The union of an object's parts is its visible surface, and each part is its own collision hull, so
that a bowl or a ring is as hollow for a finger as it is for a camera.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64
from edgegrasp_model.scene.cloud import unit
from edgegrasp_sim.engine.urdf import TriangleMesh, convex_hull

Numbers = Float64 | list[float]
Part = Float64  # (..., 3) metres: points; the part is their convex hull
Random = np.random.Generator

FINE, COARSE = 28, 16  # corners of a circle: for a solid part, for a wall with a part per side
LIE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # turns z to x
RAISE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # turns y to z


def household_mesh(rng: Random) -> tuple[str, list[TriangleMesh]]:
    """Draw an object of any family: its family's name, and closed convex parts that may overlap.

    The object stands on z = 0, centred on the z axis.
    """
    make = FAMILIES[int(rng.integers(len(FAMILIES)))]
    parts = [part.reshape(-1, 3) for part in make(rng)]
    points = np.concatenate(parts)
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    hulls = [convex_hull(part - origin) for part in parts]
    return make.__name__[1:], [hull for hull in hulls if hull is not None]


def _can(rng: Random) -> list[Part]:
    radius, height = rng.uniform(0.025, 0.05), rng.uniform(0.03, 0.18)
    rim = rng.uniform(0.001, 0.006)
    return [_solid([radius - rim, radius, radius, radius - rim], [0, rim, height - rim, height])]


def _bottle(rng: Random) -> list[Part]:
    radius, height = rng.uniform(0.02, 0.05), rng.uniform(0.12, 0.32)
    neck, shoulder = radius * rng.uniform(0.25, 0.6), height * rng.uniform(0.45, 0.8)
    cap, top = neck * rng.uniform(1.0, 1.3), height * rng.uniform(0.85, 0.93)
    slope = min(radius - neck, top - shoulder) * rng.uniform(0.5, 1.0)
    outline = oval(rng.uniform(0.4, 1.0)) * (1.0, rng.uniform(0.5, 1.0))
    if rng.random() < 0.6:
        outline = oval()
    foot = min(0.004, radius / 5)
    body = [radius - foot, radius, radius, neck + 0.3 * (radius - neck), neck]
    heights = [0.0, foot, shoulder, shoulder + 0.75 * slope, shoulder + slope]
    parts = [lofted(outline, body, heights), _solid([neck, neck], [shoulder, top])]
    return [*parts, _solid([cap, cap], [top - 0.01, height])]


def _jar(rng: Random) -> list[Part]:
    radius, height = rng.uniform(0.025, 0.055), rng.uniform(0.05, 0.16)
    lid, top = radius * rng.uniform(0.75, 1.05), height - rng.uniform(0.01, 0.02)
    body = _solid([0.93 * radius, radius, radius, lid * 0.95], [0.0, 0.004, 0.85 * top, top])
    return [body, _solid([lid, lid], [top, height])]


def _bowl(rng: Random) -> list[Part]:
    """Round or oval; a third has the straight handle of a pan."""
    radius, depth, wall = rng.uniform(0.04, 0.11), rng.uniform(0.025, 0.09), rng.uniform(2e-3, 5e-3)
    flat = rng.uniform(0.35, 0.7)
    turn = np.linspace(0.0, np.pi / 2, 4)
    radii = radius * (flat + (1.0 - flat) * np.sin(turn))
    parts = _shell(radii, depth * (1.0 - np.cos(turn)), wall, wall)
    if rng.random() < 0.33:
        length, thick = rng.uniform(0.08, 0.2), rng.uniform(0.006, 0.012)
        start = np.array([radius - wall, 0.0, depth - thick])
        end = start + np.array([length, 0.0, rng.uniform(0.0, 0.04)])
        return [*parts, _rod(start, end, thick)]
    return _placed(parts, np.diag([1.0, rng.uniform(0.7, 1.0), 1.0]))


def _cup(rng: Random) -> list[Part]:
    radius, height, wall = rng.uniform(0.03, 0.05), rng.uniform(0.05, 0.12), rng.uniform(3e-3, 5e-3)
    bottom = radius * rng.uniform(0.65, 1.0)
    parts = _shell([bottom, radius], [0.0, height], wall, rng.uniform(0.004, 0.008))
    loop, thick = height * rng.uniform(0.2, 0.32), rng.uniform(0.0025, 0.0045)
    section = oval(0.6, 8) * (thick, thick * rng.uniform(1.0, 2.0)) + (loop, 0.0)
    handle = _wedges(section, np.linspace(-np.pi / 2, np.pi / 2, 7))
    squash = np.diag([rng.uniform(0.8, 1.4), 1.0, 1.0])
    inset = (radius + bottom) / 2 - wall
    handle = _placed(handle, squash @ RAISE, (inset, 0.0, height * rng.uniform(0.42, 0.58)))
    both = _placed(handle, np.diag([-1.0, -1.0, 1.0])) if rng.random() < 0.15 else []
    return [*parts, *handle, *both]


def _plate(rng: Random) -> list[Part]:
    radius, height, wall = rng.uniform(0.06, 0.15), rng.uniform(0.01, 0.03), rng.uniform(3e-3, 6e-3)
    well = radius * rng.uniform(0.5, 0.75)
    step = radius * rng.uniform(0.04, 0.15)
    rise = height * rng.uniform(0.4, 0.8)
    return _shell([well, well + step, radius], [0.0, rise, height], wall, wall)


def _glass(rng: Random) -> list[Part]:
    radius, height = rng.uniform(0.025, 0.045), rng.uniform(0.07, 0.17)
    wall = rng.uniform(0.002, 0.004)
    if rng.random() < 0.65:
        return _shell([radius * rng.uniform(0.6, 1.0), radius], [0.0, height], wall, 2 * wall)
    stem, thick = height * rng.uniform(0.3, 0.55), rng.uniform(0.003, 0.006)
    radii, heights = radius * np.array([0.35, 0.95, 1.1, 0.9]), np.array([0.0, 0.35, 0.6, 1.0])
    bowl = _shell(radii, heights * (height - stem), wall, 2 * wall)
    bowl = _placed(bowl, np.eye(3), (0.0, 0.0, stem))
    foot = _solid([0.9 * radius, 0.9 * radius, 2 * thick], [0.0, 0.003, 0.008])
    return [foot, _solid([thick, thick], [0.0, stem + wall]), *bowl]


def _carton(rng: Random) -> list[Part]:
    """A closed box; half of the boxes are too wide for the hand on every side."""
    least = 0.085 if rng.random() < 0.5 else 0.02
    size = np.exp(rng.uniform(np.log(least), np.log(0.28), size=3))
    return [_box(size, (0.0, 0.0, 0.0), rng.uniform(0.0, 0.03))]


def _tray(rng: Random) -> list[Part]:
    x, y = rng.uniform(0.06, 0.28, size=2)
    z, wall = rng.uniform(0.025, 0.12), rng.uniform(0.002, 0.006)
    return [_box((x, y, wall), (0.0, 0.0, wall / 2)), *_walls(x, y, z, wall)]


def _book(rng: Random) -> list[Part]:
    """Covers are a little larger than the pages; a quarter of the books stand."""
    x, y, z = rng.uniform(0.1, 0.28), rng.uniform(0.08, 0.21), rng.uniform(0.008, 0.06)
    cover, inset = rng.uniform(0.001, 0.003), rng.uniform(0.0, 0.005)
    parts = [_box((x, y, cover), (0.0, 0.0, side * (z - cover) / 2)) for side in (-1.0, 1.0)]
    parts.append(_box((x - 2 * inset, y - inset, z), (0.0, -inset / 2, 0.0)))
    return _placed(parts, RAISE) if rng.random() < 0.25 else parts


def _torch(rng: Random) -> list[Part]:
    """A torch that lies, or stands on its head."""
    grip, length = rng.uniform(0.009, 0.018), rng.uniform(0.08, 0.22)
    head, neck = grip * rng.uniform(1.1, 2.0), length * rng.uniform(0.15, 0.35)
    parts = [_solid([head, head, grip], [0.0, 0.5 * neck, neck])]
    parts.append(_solid([grip, grip, 0.85 * grip], [0.0, length - 0.004, length]))
    return parts if rng.random() < 0.25 else _placed(parts, LIE)


def _hammer(rng: Random) -> list[Part]:
    length, grip = rng.uniform(0.18, 0.33), rng.uniform(0.010, 0.017)
    handle = _placed([lofted(oval() * (0.75, 1.0), [grip, grip, 0.7 * grip], [0, 0.4, 1])], LIE)
    thick, span = rng.uniform(0.018, 0.036), rng.uniform(0.07, 0.13)
    poll, claw = np.array([length, span / 2, 0.0]), np.array([length, -span / 2, 0.0])
    middle = (poll + claw) / 2
    head = [_rod(middle, poll, thick / 2), _rod(middle, claw, thick / 2, thick / 6)]
    return [*_placed(handle, np.diag([length, 1.0, 1.0])), *head]


def _screwdriver(rng: Random) -> list[Part]:
    grip, handle = rng.uniform(0.009, 0.018), rng.uniform(0.06, 0.12)
    shaft, length = rng.uniform(0.002, 0.005), rng.uniform(0.05, 0.17)
    outline = oval(1.0, int(rng.choice([6, 8, FINE])))
    body = lofted(outline, [0.7 * grip, grip, grip, 0.6 * grip], [0, 0.15, 0.7, 1])
    parts = _placed([body], np.diag([1.0, 1.0, handle]))
    return _placed([*parts, _solid([shaft, shaft], [handle - 0.01, handle + length])], LIE)


def _spanner(rng: Random) -> list[Part]:
    """A flat bar, with an open jaw at one end and a ring or a jaw at the other."""
    length, thick = rng.uniform(0.1, 0.26), rng.uniform(0.004, 0.01)
    parts = [_box((length, rng.uniform(0.008, 0.018), thick), (0.0, 0.0, 0.0))]
    for side, opening in ((1.0, rng.uniform(0.5, 0.8)), (-1.0, rng.choice([0.0, 0.6]))):
        inner = rng.uniform(0.006, 0.013)
        outer = inner + rng.uniform(0.005, 0.01)
        middle = np.array([(inner + outer) / 2, 0.0])
        section = middle + _rectangle(outer - inner, 1.3 * thick)
        head = _wedges(section, np.linspace(opening, 2 * np.pi - opening, COARSE - 3))
        turned = np.diag([side, side, 1.0])
        parts += _placed(head, turned, (side * (length / 2 + inner), 0.0, 0.0))
    return parts


def _scissors(rng: Random) -> list[Part]:
    blade, thick = rng.uniform(0.05, 0.12), rng.uniform(0.002, 0.004)
    spread, shank = rng.uniform(0.08, 0.35), rng.uniform(0.03, 0.06)
    loop, rod = rng.uniform(0.013, 0.022), rng.uniform(0.003, 0.005)
    parts: list[Part] = []
    for side in (-1.0, 1.0):
        outline = np.array([[-shank, -0.006], [blade, -0.001], [blade, 0.001], [-shank, 0.006]])
        flat = lofted(outline, [1.0, 1.0], [0.0, thick])
        eye = _wedges(oval(1.0, 8) * rod + (loop, 0.0), np.linspace(0, 2 * np.pi, COARSE + 1))
        long = np.diag([rng.uniform(1.0, 1.5), 1.0, 1.0])
        eye = _placed(eye, long, (-shank - loop, side * 0.3 * loop, thick / 2))
        turn = Rotation.from_euler("z", side * spread / 2).as_matrix()
        parts += _placed([flat, *eye], turn, (0.0, 0.0, side * thick / 2))
    return [*parts, _solid([0.005, 0.005], [-thick, 2 * thick])]


def _clamp(rng: Random) -> list[Part]:
    reach, opening = rng.uniform(0.03, 0.08), rng.uniform(0.03, 0.11)
    bar, thick = rng.uniform(0.010, 0.018), rng.uniform(0.008, 0.015)
    side = opening / 2 + bar / 2
    parts = [_box((bar, opening + 2 * bar, thick), (0.0, 0.0, 0.0))]
    parts += [_box((reach, bar, thick), (reach / 2, at, 0.0)) for at in (-side, side)]
    tip = np.array([reach - bar / 2, rng.uniform(-opening / 2, opening / 4), 0.0])
    end = np.array([tip[0], side + rng.uniform(0.02, 0.07), 0.0])
    across = np.array([rng.uniform(0.015, 0.03), 0.0, 0.0])
    parts += [_rod(tip, end, 0.35 * thick), _rod(end - across, end + across, 3e-3)]
    return [*parts, _rod(tip, tip - (0.0, 0.006, 0.0), 0.6 * thick)]


def _pen(rng: Random) -> list[Part]:
    radius, length = rng.uniform(0.0035, 0.01), rng.uniform(0.11, 0.18)
    cap = radius * rng.uniform(1.0, 1.2)
    outline = oval(1.0, int(rng.choice([6, FINE])))
    body = lofted(outline, [0.3 * radius, radius, radius], [0, 0.02, length])
    return _placed([body, _solid([cap, cap], [length * rng.uniform(0.6, 0.9), length])], LIE)


def _fruit(rng: Random) -> list[Part]:
    """A sphere to a spindle, a third of them a pear or a banana."""
    kind = rng.random()
    if kind < 0.15:
        radius, bend = rng.uniform(0.014, 0.02), rng.uniform(0.06, 0.11)
        angles = np.linspace(0.0, rng.uniform(1.0, 1.7), 7)
        parts = _wedges(oval(1.0, 8) * radius + (bend, 0.0), angles)
        for angle, way in ((0.0, -1.0), (angles[-1], 1.0)):
            along = way * np.array([-np.sin(angle), np.cos(angle), 0.0])
            centre = bend * np.array([np.cos(angle), np.sin(angle), 0.0])
            tip = centre + rng.uniform(1.0, 2.5) * radius * along
            parts.append(_rod(centre, tip, radius, 0.005))
        return parts
    radius = rng.uniform(0.022, 0.05) if rng.random() < 0.85 else rng.uniform(0.05, 0.09)
    turn = np.linspace(-0.47, 0.47, 10) * np.pi
    stretch = np.array([rng.uniform(0.85, 1.0), rng.uniform(0.85, 1.0), rng.uniform(0.75, 1.1)])
    parts = [_solid(radius * np.cos(turn), radius * np.sin(turn))]
    if kind < 0.3:
        top, radii = radius * rng.uniform(1.2, 1.9), [0.88 * radius, 0.4 * radius, 0.2 * radius]
        parts.append(_solid(radii, [0.47 * radius, top, 1.08 * top]))
    if kind > 0.6:
        stretch[2] *= rng.uniform(1.0, 1.4)
    parts = _placed(parts, np.diag(stretch))
    return _placed(parts, LIE) if kind > 0.7 else parts


def _bag(rng: Random) -> list[Part]:
    """A bulged box, some with the flat seam of a packet at both ends."""
    x, y, z = rng.uniform((0.06, 0.04, 0.02), (0.26, 0.18, 0.12))
    sharp = rng.uniform(0.3, 0.8)
    turn = np.linspace(-0.48, 0.48, 12) * np.pi
    heights = np.sign(turn) * np.abs(np.sin(turn)) ** sharp
    body = lofted(oval(rng.uniform(0.3, 0.7)), np.cos(turn) ** sharp, heights)
    lean = np.array([[x / 2, 0.0, 0.0], [0.0, y / 2, 0.0], [0.0, 0.0, z / 2]])
    lean[:2, 2] = rng.uniform(-0.1, 0.1, size=2) * z
    parts = _placed([body], lean)
    if rng.random() < 0.4:
        parts.append(_box((x + rng.uniform(0.01, 0.03), 0.8 * y, 0.0015), (0.0, 0.0, 0.0)))
    return _placed(parts, LIE.T) if rng.random() < 0.3 else parts


def _ring(rng: Random) -> list[Part]:
    """A roll of tape, a pipe, a bracelet; some stand on their edge."""
    outer, height = rng.uniform(0.025, 0.07), rng.uniform(0.008, 0.07)
    inner = outer * rng.uniform(0.45, 0.93)
    section = oval(1.0, 8) if rng.random() < 0.4 else _rectangle(2.0, 2.0)
    section = section * ((outer - inner) / 2, height / 2) + ((inner + outer) / 2, 0.0)
    parts = _wedges(section, np.linspace(0.0, 2 * np.pi, COARSE + 5))
    return _placed(parts, RAISE) if rng.random() < 0.15 else parts


def _frame(rng: Random) -> list[Part]:
    x, y = rng.uniform(0.06, 0.28, size=2)
    bar, thick = min(rng.uniform(0.006, 0.03), 0.2 * min(x, y)), rng.uniform(0.006, 0.03)
    return _walls(x, y, thick, bar)


FAMILIES = (
    *(_can, _bottle, _jar, _bowl, _cup, _plate, _glass, _carton, _tray, _book, _torch),
    *(_hammer, _screwdriver, _spanner, _scissors, _clamp, _pen, _fruit, _bag, _ring, _frame),
)


def oval(sharp: float = 1.0, corners: int = FINE) -> Float64:
    """A circle of radius one (corners, 2); `sharp` below one makes it squarer."""
    angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.sign(ring) * np.abs(ring) ** sharp)


def _rectangle(x: float, y: float) -> Float64:
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2


def lofted(outline: Float64, widths: Numbers, heights: Numbers) -> Float64:
    """An outline (S, 2) scaled by one width (R,) or two widths (R, 2) at each height: (R, S, 3)."""
    rings = np.empty((len(widths), len(outline), 3))
    rings[..., :2] = outline * np.reshape(widths, (len(widths), 1, -1))
    rings[..., 2] = np.asarray(heights)[:, None]
    return rings


def swept(section: Float64, angles: Float64) -> Float64:
    """Radii and heights (S, 2), or (R, S, 2) for each angle, rotated about z: (R, S, 3)."""
    rings = np.empty((len(angles), section.shape[-2], 3))
    rings[..., 0] = np.cos(angles)[:, None] * section[..., 0]
    rings[..., 1] = np.sin(angles)[:, None] * section[..., 0]
    rings[..., 2] = section[..., 1]
    return rings


def _solid(radii: Numbers, heights: Numbers) -> Part:
    """A solid of revolution about z with a convex profile."""
    return lofted(oval(), radii, heights)


def _box(size: ArrayLike, centre: ArrayLike, cut: float = 0.0) -> Part:
    """A box with bevelled upright edges; `cut` is the bevel as a share of its smaller side."""
    x, y, z = np.asarray(size) / 2
    cut = cut * 2 * min(x, y)
    outline = np.concatenate([_rectangle(2 * (x - cut), 2 * y), _rectangle(2 * x, 2 * (y - cut))])
    return _placed([lofted(outline, [1.0, 1.0], [-z, z])], np.eye(3), centre)[0]


def _walls(x: float, y: float, z: float, thick: float) -> list[Part]:
    """Four bars around an opening; outer size x by y, height z."""
    sides = -1.0, 1.0
    parts = [_box((x, thick, z), (0.0, side * (y - thick) / 2, z / 2)) for side in sides]
    return parts + [_box((thick, y, z), (side * (x - thick) / 2, 0.0, z / 2)) for side in sides]


def _rod(start: Float64, end: Float64, first: float, last: float = 0.0) -> Part:
    """A round rod from one point to another, with the radius at each end; default: equal radii."""
    z = unit(end - start)
    x = unit(np.cross(z, (0.0, 0.0, 1.0) if abs(z[2]) < 0.9 else (1.0, 0.0, 0.0)))
    frame = np.stack([x, np.cross(z, x), z], axis=1)
    ends = [0.0, float(np.linalg.norm(end - start))]
    rod = lofted(oval(1.0, COARSE), [first, last or first], ends)
    return _placed([rod], frame, start)[0]


def _wedges(section: Float64, angles: Float64) -> list[Part]:
    """A convex section (P, 2) of radius and height swept about z, one part per pair of angles."""
    rings = swept(section, angles)
    return [rings[k : k + 2] for k in range(len(angles) - 1)]


def _shell(radii: Numbers, heights: Numbers, wall: float, floor: float) -> list[Part]:
    """A vessel from its outer profile, from the foot up, and the thickness of wall and floor."""
    outside = np.stack([radii, heights], axis=1)
    way = unit(np.diff(outside, axis=0))
    way = unit(np.concatenate([way[:1], way[1:] + way[:-1], way[-1:]]))
    inside = outside + wall * np.stack([-way[:, 1], way[:, 0]], axis=1)
    angles = 2 * np.pi * (np.arange(COARSE + 1) + 0.5) / COARSE
    parts = [lofted(oval(1.0, COARSE), [outside[0, 0]] * 2, [0.0, floor])]
    for k in range(len(way) - 1):
        section = np.array([outside[k], outside[k + 1], inside[k + 1], inside[k]])
        parts += _wedges(section, angles)
    return parts


def _placed(parts: list[Part], turn: Float64, place: ArrayLike = 0.0) -> list[Part]:
    return [part @ turn.T + np.asarray(place) for part in parts]
