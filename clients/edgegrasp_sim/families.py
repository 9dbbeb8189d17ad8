"""Objects of families that common object sets hardly hold: thin, flat and large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from edgegrasp_sim.scene import OBJECT_MASS

if TYPE_CHECKING:
    from pathlib import Path

Size = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Shape:
    """A box, or a cylinder that stands upright.

    Attributes:
        size: full extents along x, y and z, metres; x and y of a cylinder are its diameter.
        round: whether it is a cylinder.
    """

    size: Size
    round: bool = False

    def urdf(self, name: str) -> str:
        """Its description."""
        x, y, z = self.size
        shape = (
            f'<cylinder radius="{x / 2:.5f}" length="{z:.5f}"/>'
            if self.round
            else f'<box size="{x:.5f} {y:.5f} {z:.5f}"/>'
        )
        return f"""<?xml version="1.0"?>
<robot name="{name}">
  <link name="base_link">
    <inertial>
      <mass value="{OBJECT_MASS}"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
    </inertial>
    <visual><geometry>{shape}</geometry></visual>
    <collision><geometry>{shape}</geometry></collision>
  </link>
</robot>
"""


def _tube(diameter: float, length: float) -> Shape:
    return Shape((diameter, diameter, length), round=True)


# Sizes in metres as they come into a scene. Thin: nothing over 14 mm across. Flat: 8 to 14 mm
# high and too wide to grasp but over the edge. Large: little room in a hand that opens 80 mm.
FAMILIES: dict[str, tuple[Shape, ...]] = {
    "regular": (
        Shape((0.03, 0.03, 0.08)),
        Shape((0.04, 0.04, 0.04)),
        Shape((0.03, 0.05, 0.07)),
        _tube(0.03, 0.08),
        _tube(0.04, 0.06),
        _tube(0.05, 0.05),
    ),
    "thin": (
        Shape((0.008, 0.008, 0.09)),
        Shape((0.012, 0.012, 0.12)),
        Shape((0.010, 0.014, 0.10)),
        _tube(0.008, 0.09),
        _tube(0.010, 0.12),
        _tube(0.014, 0.10),
    ),
    "flat": (
        Shape((0.05, 0.07, 0.008)),
        Shape((0.06, 0.06, 0.011)),
        Shape((0.05, 0.10, 0.014)),
        _tube(0.06, 0.008),
        _tube(0.06, 0.011),
        _tube(0.07, 0.014),
    ),
    "large": (
        Shape((0.065, 0.065, 0.10)),
        Shape((0.06, 0.09, 0.12)),
        Shape((0.07, 0.07, 0.07)),
        _tube(0.06, 0.12),
        _tube(0.065, 0.10),
        _tube(0.07, 0.08),
    ),
}


def write_family(name: str, folder: Path) -> Path:
    """Write the objects of a family into a folder, for `ObjectSet.from_folder`; returns it.

    Args:
        name: one of `FAMILIES`.
        folder: made if need be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, shape in enumerate(FAMILIES[name]):
        title = f"{name}-{number}"
        (folder / f"{title}.urdf").write_text(shape.urdf(title))
    return folder
