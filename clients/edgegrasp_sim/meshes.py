"""Objects from plain meshes: scaled to the hand, taken apart into convex parts, kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edgegrasp_sim.scene import OBJECT_FRICTION, OBJECT_MASS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MESH_SUFFIXES = (".obj", ".stl")
LAYOUT = 1  # of a kept object; raised whenever what is written changes
SHORTEST_SIDE = 0.06  # metres, of the box around an object: between the fingers, with room
LONGEST_SIDE = 0.15  # metres: within the workspace, five of them
# How closely convex parts follow a concave surface, as a share of its size (coacd's threshold).
CONCAVITY = 0.05
# A short search for cuts: a second or two for a closed mesh, a minute for a torn one.
SEARCH = {"mcts_iterations": 20, "mcts_nodes": 8, "mcts_max_depth": 2, "resolution": 1000}
CACHE_FOLDER = "edgegrasp"

logger = logging.getLogger(__name__)


def prepare_mesh(mesh: Path, cache: Path | None = None) -> Path:
    """Make an object that can be simulated of a mesh; the second time it is only looked up.

    The mesh is scaled so that the box around it has a shortest side of `SHORTEST_SIDE`, and no
    side over `LONGEST_SIDE`. Its own unit does not matter; its z axis points up in packed scenes.
    It is seen as it is and touched as convex parts, with the mass and friction of every object.

    Args:
        mesh: `.obj` or `.stl` file.
        cache: folder to keep prepared objects in, by the digest of the file and of how it is
            prepared; the user's cache folder by default.

    Returns:
        The object's URDF file.

    Raises:
        ValueError: the file holds no solid mesh.
        RuntimeError: coacd or trimesh is not installed.
    """
    _require_packages()
    folder = (cache or cache_folder()) / _digest(mesh)
    urdf = folder / "object.urdf"
    if urdf.is_file():
        return urdf
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=folder.parent))
    try:
        parts = _write_object(mesh, unfinished)
        with contextlib.suppress(OSError):  # another process was faster, with the same result
            unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    logger.info("%s: %d convex parts", mesh.name, parts)
    return urdf


def cache_folder() -> Path:
    """Where prepared objects are kept: below `$XDG_CACHE_HOME`, else below `~/.cache`."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / CACHE_FOLDER / "meshes"


def _require_packages() -> None:
    try:
        import coacd  # noqa: F401
        import trimesh  # noqa: F401
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"{error.name} is not installed, and meshes need it: pip install 'edgegrasp[meshes]'"
        ) from None


def _digest(mesh: Path) -> str:
    """SHA-256 of a mesh and of everything that decides what is made of it."""
    recipe = {
        "layout": LAYOUT,
        "shortest_side": SHORTEST_SIDE,
        "longest_side": LONGEST_SIDE,
        "concavity": CONCAVITY,
        "search": SEARCH,
        "mass": OBJECT_MASS,
        "friction": OBJECT_FRICTION,
        "coacd": version("coacd"),
        "suffix": mesh.suffix.lower(),
    }
    digest = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode())
    digest.update(mesh.read_bytes())
    return digest.hexdigest()


def _write_object(mesh: Path, folder: Path) -> int:
    """Write URDF, visual and collision mesh into a folder; returns the number of convex parts."""
    import trimesh

    surface = _read(mesh)
    sides = np.sort(surface.bounding_box_oriented.primitive.extents)
    surface.apply_scale(min(SHORTEST_SIDE / sides[0], LONGEST_SIDE / sides[2]))
    surface.apply_translation(-surface.bounds.mean(axis=0))
    parts = _convex_parts(surface)
    solid: Any = trimesh.util.concatenate(parts)
    solid.density = OBJECT_MASS / solid.volume
    _write_obj(folder / "object_visual.obj", [surface])
    _write_obj(folder / "object_collision.obj", parts)
    urdf = _urdf(solid.center_mass, solid.moment_inertia)
    (folder / "object.urdf").write_text(urdf)
    return len(parts)


def _read(mesh: Path) -> Any:
    """The triangles of a file as one mesh.

    Raises:
        ValueError: there are none, they cannot be read, or they lie in a plane.
    """
    import trimesh

    try:
        surface: Any = trimesh.load(mesh, force="mesh", process=True, skip_materials=True)
    except Exception as error:  # readers of meshes raise whatever they stumble over
        raise ValueError(f"{mesh} cannot be read as a mesh: {error}") from error
    if len(surface.faces) == 0 or surface.extents is None:
        raise ValueError(f"{mesh} holds no triangles; export the object as a triangle mesh")
    if not np.isfinite(surface.vertices).all() or min(surface.extents) <= 1e-9:
        raise ValueError(f"{mesh} is no solid object (its extents are {surface.extents.tolist()})")
    return surface


def _convex_parts(surface: Any) -> list[Any]:
    """Convex meshes that together fill a mesh."""
    import coacd
    import trimesh

    coacd.set_log_level("error")
    mesh = coacd.Mesh(np.asarray(surface.vertices), np.asarray(surface.faces))
    parts = coacd.run_coacd(mesh, threshold=CONCAVITY, seed=0, **SEARCH)
    return [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in parts]


def _write_obj(path: Path, meshes: Sequence[Any]) -> None:
    """An OBJ file with one object for each mesh; the engine makes a convex hull of each."""
    lines, before = [], 1
    for number, mesh in enumerate(meshes):
        lines.append(f"o part_{number}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + before]
        before += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")


def _urdf(centre: NDArray[np.float64], inertia: NDArray[np.float64]) -> str:
    """The description of an object with this centre of mass and inertia, metres and kg."""
    xyz = " ".join(f"{value:.7f}" for value in centre)
    names = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2),
             ("izz", 2, 2))  # fmt: skip
    moments = " ".join(f'{name}="{inertia[row, column]:.9f}"' for name, row, column in names)
    return f"""<?xml version="1.0"?>
<robot name="object">
  <link name="base_link">
    <contact><lateral_friction value="{OBJECT_FRICTION}"/></contact>
    <inertial>
      <origin xyz="{xyz}"/>
      <mass value="{OBJECT_MASS}"/>
      <inertia {moments}/>
    </inertial>
    <visual><geometry><mesh filename="object_visual.obj"/></geometry></visual>
    <collision><geometry><mesh filename="object_collision.obj"/></geometry></collision>
  </link>
</robot>
"""
