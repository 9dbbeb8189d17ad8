"""Objects whose surface is computed, not scanned: an OBJ file and the description beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edgegrasp_sim.scene import OBJECT_MASS

if TYPE_CHECKING:
    from pathlib import Path


def write_object(name: str, surface: str, folder: Path) -> Path:
    """Write `<name>.obj` and `<name>.urdf`; the engine takes the convex hull of the surface.

    Args:
        name: of the object.
        surface: as an OBJ file, metres.
        folder: made if need be.

    Returns:
        The description.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.obj").write_text(surface)
    urdf = folder / f"{name}.urdf"
    urdf.write_text(_urdf(name))
    return urdf


def _urdf(name: str) -> str:
    """The description of the object whose surface is `<name>.obj`."""
    shape = f'<mesh filename="{name}.obj"/>'
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
