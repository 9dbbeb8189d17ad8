"""Objects of families that common object sets hardly hold: thin, flat and large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edgegrasp_sim.made_objects import write_object

if TYPE_CHECKING:
    from pathlib import Path

Size = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Prism:
    """A prism with a regular base, which does not roll as a cylinder would.

    Attributes:
        sides: of the base, 4 or more.
        size: full extents along x, y and z, metres.
        axis: that the prism's lengthwise axis lies along: 0, 1 or 2.
    """

    sides: int
    size: Size
    axis: int = 2

    def obj(self) -> str:
        """Its surface as an OBJ file; the engine takes the convex hull of it."""
        angles = np.pi / self.sides * (2 * np.arange(self.sides) + 1)
        base = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        base /= np.ptp(base, axis=0)  # extents of one
        corners = np.concatenate([np.insert(base, 2, end, axis=1) for end in (-0.5, 0.5)])
        corners = np.roll(corners, self.axis - 2, axis=1) * self.size
        n = self.sides
        faces = [(k, (k + 1) % n, (k + 1) % n + n) for k in range(n)]
        faces += [(k, (k + 1) % n + n, k + n) for k in range(n)]
        faces += [(0, k + 1, k) for k in range(1, n - 1)]
        faces += [(n, n + k, n + k + 1) for k in range(1, n - 1)]
        lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in corners]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
        return "\n".join(lines) + "\n"


def _box(x: float, y: float, z: float) -> Prism:
    return Prism(4, (x, y, z))


def _can(diameter: float, height: float) -> Prism:
    return Prism(10, (diameter, diameter, height))


def _rod(diameter: float, length: float) -> Prism:
    return Prism(6, (length, diameter, diameter), axis=0)


# Sizes in metres as they come into a scene, upright as they stand in a packed one. Thin: at most
# 14 mm across, lying. Flat: 8 to 14 mm high. Large: 60 to 70 mm in a hand that opens 80 mm.
FAMILIES: dict[str, tuple[Prism, ...]] = {
    "regular": (
        _box(0.03, 0.03, 0.08),
        _box(0.04, 0.04, 0.04),
        _box(0.03, 0.05, 0.07),
        _can(0.03, 0.08),
        _can(0.04, 0.06),
        _can(0.05, 0.05),
    ),
    "thin": (
        _box(0.09, 0.008, 0.008),
        _box(0.12, 0.012, 0.012),
        _box(0.10, 0.014, 0.010),
        _rod(0.008, 0.09),
        _rod(0.010, 0.12),
        _rod(0.014, 0.10),
    ),
    "flat": (
        _box(0.05, 0.07, 0.008),
        _box(0.06, 0.06, 0.011),
        _box(0.05, 0.10, 0.014),
        _can(0.06, 0.008),
        _can(0.06, 0.011),
        _can(0.07, 0.014),
    ),
    "large": (
        _box(0.065, 0.065, 0.10),
        _box(0.06, 0.09, 0.12),
        _box(0.07, 0.07, 0.07),
        _can(0.06, 0.12),
        _can(0.065, 0.10),
        _can(0.07, 0.08),
    ),
}


def write_family(name: str, folder: Path) -> Path:
    """Write the objects of a family into a folder, for `ObjectSet.from_folder`; returns it.

    Args:
        name: one of `FAMILIES`.
        folder: made if need be.
    """
    for number, shape in enumerate(FAMILIES[name]):
        write_object(f"{name}-{number}", shape.obj(), folder)
    return folder
