"""Objects for scenes: folders of URDF files or meshes, built-in objects, computed objects.

A mesh is scaled to the hand, decomposed into convex parts and cached on disk.
"""

import hashlib
import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Never
from xml.etree import ElementTree

import numpy as np

from edgegrasp_camera.arrays import Float64, Int64
from edgegrasp_sim.engine import OBJECT_MASS
from edgegrasp_sim.engine.urdf import convex_hull

MESH_SUFFIXES = (".obj", ".stl")
LAYOUT = 1  # of cached objects; raised whenever what is written changes
SHORTEST_SIDE = 0.06  # metres, of an object's bounding box; fits between the fingers
LONGEST_SIDE = 0.15  # metres; five such objects fit into the workspace
# Greatest error of convex parts at a concave surface, as a share of its size (coacd's threshold).
CONCAVITY = 0.05
# A short search for cuts: a second or two for a closed mesh, a minute for one with holes.
SEARCH = {"mcts_iterations": 20, "mcts_nodes": 8, "mcts_max_depth": 2, "resolution": 1000}
Size = tuple[float, float, float]
Mesh = tuple[Float64, Int64]  # points (P, 3), triangles (F, 3)


class SceneKind(StrEnum):
    """Kind of a scene: objects upright, in a heap, in a bin, on a table or on a shelf."""

    PACKED = "packed"
    PILE = "pile"
    BIN = "bin"
    TABLE = "table"
    FULL_BIN = "bin-full"
    DEEP_BIN = "bin-deep"
    SHELF = "shelf"

    @property
    def objects(self) -> "SceneKind":
        """The kind whose objects are used if a folder has none for this kind."""
        upright = self in (SceneKind.PACKED, SceneKind.TABLE, SceneKind.SHELF)
        return SceneKind.PACKED if upright else SceneKind.PILE

    @classmethod
    def _missing_(cls, value: object) -> Never:
        raise ValueError(f"scene is {value!r}; choose one of {', '.join(cls)}")


CLUTTER = (SceneKind.PACKED, SceneKind.PILE)  # kinds of the published clutter removal


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """An object that can be put into a scene."""

    name: str  # unique within its set
    urdf: Path  # its description
    scale: float = 1.0  # factor that fits it to the hand, before a scene's own scale
    unstretched: "ObjectModel | None" = None  # the original, if it is a stretched copy

    @property
    def files(self) -> list[Path]:
        """Its URDF file and the meshes that it names, sorted; raises ValueError if unusable."""
        try:
            root = ElementTree.parse(self.urdf).getroot()
        except ElementTree.ParseError as error:
            raise ValueError(f"{self.urdf} cannot be read: {error}") from error
        if (links := len(root.findall("link"))) != 1:
            raise ValueError(f"{self.urdf} has {links} links; describe an object as one link")
        named = {self.urdf.parent / mesh.get("filename", "") for mesh in root.iter("mesh")}
        if missing := sorted(str(path) for path in named if not path.is_file()):
            raise ValueError(f"{self.urdf} names {missing[0]}, which is not a file; correct it")
        return sorted({self.urdf} | named)

    @property
    def digest(self) -> str:
        """SHA-256 of its files, in hex."""
        contents = [hashlib.sha256(file.read_bytes()).digest() for file in self.files]
        return hashlib.sha256(b"".join(contents)).hexdigest()


@dataclass(frozen=True, slots=True)
class ObjectSet:
    """Objects to draw scenes from."""

    name: str  # name of the set in a report
    models: tuple[ObjectModel, ...]  # at least one, in the same order on every machine

    @property
    def digest(self) -> str:
        """SHA-256 of the names, scales and files of the objects, in hex."""
        digest = hashlib.sha256()
        for model in self.models:
            digest.update(f"{model.name} {model.scale}".encode())
            for file in model.files:
                digest.update(file.read_bytes())
        return digest.hexdigest()

    def check_same(self, digest: str) -> None:
        """Raise ValueError unless the set has this digest, which was read elsewhere or earlier."""
        if self.digest != digest:
            raise ValueError(
                f"the objects {self.name} differ between the machines of the cluster, or from those"
                " of the recorded benchmark; use the same folder, on each at the same path"
            )

    def sample(self, rng: np.random.Generator) -> ObjectModel:
        """Draw one object, uniformly."""
        return self.models[int(rng.integers(len(self.models)))]

    @classmethod
    def from_folder(cls, root: Path | None, scene: SceneKind, split: str = "test") -> "ObjectSet":
        """The objects of a folder, sorted by name; raises as `prepare_mesh`, or FileNotFoundError.

        URDF files, else `.obj` or `.stl` meshes, in `<root>/<scene>/<split>` (VGN's layout) or in
        `root` itself. Bins, tables and shelves without a folder of their own use that of piles or
        packed scenes. Without a `root`, the objects of `builtin`.
        """
        if root is None:
            return cls.builtin(scene)
        folder, name = root, root.name
        for kind in (scene.objects, scene):
            if (root / kind / split).is_dir():
                folder, name = root / kind / split, f"{kind}/{split}"
        urdfs = sorted(folder.glob("*.urdf"))
        if urdfs:
            return cls(name, tuple(ObjectModel(path.stem, path) for path in urdfs))
        meshes = sorted(path for path in folder.glob("*") if path.suffix.lower() in MESH_SUFFIXES)
        if not meshes:
            raise FileNotFoundError(
                f"no *.urdf, *.obj or *.stl files in {folder}; an object folder holds them, or "
                "<scene>/<split>/<name>.urdf with scene packed or pile and split train or test"
            )
        names = [path.stem for path in meshes]
        if twice := sorted({each for each in names if names.count(each) > 1}):
            raise ValueError(f"{folder} holds several meshes named {', '.join(twice)}; keep one")
        return cls(name, tuple(ObjectModel(path.stem, prepare_mesh(path)) for path in meshes))

    @classmethod
    def builtin(cls, scene: SceneKind) -> "ObjectSet":
        """Graspable objects that need no files: boxes, cans, and for piles also random shapes."""
        folder = _kept_in(f"builtin-{LAYOUT}", _write_builtin)
        names = [f"{family}-{k}" for family, shapes in STANDING.items() for k in range(len(shapes))]
        if scene.objects is SceneKind.PILE:
            names += [f"blob_{number:03d}" for number in range(_BLOBS)]
        models = tuple(ObjectModel(name, folder / f"{name}.urdf") for name in names)
        return cls(f"builtin/{scene}", models)


def blob(number: int, folder: Path, scale: float = 1.0) -> ObjectModel:
    """Write a convex object of random shape, determined by its number, into a folder."""
    rng = np.random.default_rng(number)
    directions = rng.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    half = rng.uniform((0.018, 0.025, 0.03), (0.035, 0.05, 0.065))
    hull = convex_hull(directions * half * rng.uniform(0.75, 1.0, size=(30, 1)))
    assert hull is not None
    name = f"blob_{number:03d}"
    return ObjectModel(name, write_object(name, as_obj([hull]), folder), scale)


def prepare_mesh(mesh: Path) -> Path:
    """Make a simulated object from an `.obj` or `.stl` file, or look it up; returns its URDF file.

    Its bounding box gets a shortest side of `SHORTEST_SIDE`, and no side over `LONGEST_SIDE`; z
    points up in packed scenes. The camera sees the mesh itself; contacts use its convex parts.
    Raises ValueError if it is not a solid mesh, ModuleNotFoundError without coacd or trimesh.
    """
    try:
        import coacd
        import trimesh
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{error.name} is not installed, and meshes need it: pip install 'edgegrasp[meshes]'"
        ) from None

    def write(folder: Path) -> None:
        surface = _read(mesh)
        sides = np.sort(surface.bounding_box_oriented.primitive.extents)
        surface.apply_scale(min(SHORTEST_SIDE / sides[0], LONGEST_SIDE / sides[2]))
        surface.apply_translation(-surface.bounds.mean(axis=0))
        coacd.set_log_level("error")
        whole = coacd.Mesh(np.asarray(surface.vertices), np.asarray(surface.faces))
        solids = coacd.run_coacd(whole, threshold=CONCAVITY, seed=0, **SEARCH)
        parts = [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in solids]
        solid: Any = trimesh.util.concatenate(parts)
        visible, hulls = ([(m.vertices, m.faces) for m in meshes] for meshes in ([surface], parts))
        write_parts("object", visible, hulls, solid.center_mass, folder)

    # All parameters that determine the prepared object.
    sizes = SHORTEST_SIDE, LONGEST_SIDE, CONCAVITY
    recipe = LAYOUT, sizes, SEARCH, version("coacd"), mesh.suffix.lower()
    digest = hashlib.sha256(repr(recipe).encode() + mesh.read_bytes()).hexdigest()
    return _kept_in(digest, write) / "object.urdf"


def cache_folder() -> Path:
    """The folder of prepared objects, in `$XDG_CACHE_HOME`, else in `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edgegrasp" / "meshes"


def write_object(name: str, surface: str, folder: Path) -> Path:
    """Write an object from an OBJ `surface` in metres; the engine uses its convex hull."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.obj").write_text(surface)
    return _write_urdf(folder, name, name, name)


def write_parts(
    name: str,  # of the object
    visible: Iterable[Mesh],  # meshes that a camera sees, metres
    parts: Iterable[Mesh],  # convex meshes; the engine uses the hull of each
    centre: Float64,  # (3,) its centre of mass, metres
    folder: Path,  # gets the meshes and `<name>.urdf`; created if missing
) -> Path:
    """Write an object of convex parts, which may be hollow; returns its URDF file."""
    folder.mkdir(parents=True, exist_ok=True)
    names = f"{name}_visual", f"{name}_collision"
    for mesh, surfaces in zip(names, (visible, parts), strict=True):
        (folder / f"{mesh}.obj").write_text(as_obj(surfaces, named=True))
    xyz = " ".join(f"{value:.7f}" for value in centre)
    return _write_urdf(folder, name, *names, f'<origin xyz="{xyz}"/>')


def as_obj(
    meshes: Iterable[Mesh],  # points (P, 3) and triangles (F, 3) of each
    *,
    named: bool = False,  # whether each mesh is a named object, of which the engine uses the hull
) -> str:
    """Meshes as one OBJ file."""
    lines, before, decimals = [], 1, 7 if named else 6
    for number, (points, faces) in enumerate(meshes):
        if named:
            lines.append(f"o part_{number}")
        lines += [f"v {x:.{decimals}f} {y:.{decimals}f} {z:.{decimals}f}" for x, y, z in points]
        lines += [f"f {a} {b} {c}" for a, b, c in faces + before]
        before += len(points)
    return "\n".join(lines) + "\n"


def _prism(sides: int, size: Size) -> str:
    """An upright prism with a regular base as an OBJ file; unlike a cylinder it does not roll.

    `sides` is the number of sides of the base, 4 or more; `size` are the full extents, metres.
    """
    angles = np.pi / sides * (2 * np.arange(sides) + 1)
    base = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    base /= np.ptp(base, axis=0)  # extents of one
    corners = np.concatenate([np.insert(base, 2, end, axis=1) for end in (-0.5, 0.5)]) * size
    faces = [(k, (k + 1) % sides, (k + 1) % sides + sides) for k in range(sides)]
    faces += [(k, (k + 1) % sides + sides, k + sides) for k in range(sides)]
    faces += [(0, k + 1, k) for k in range(1, sides - 1)]
    faces += [(sides, sides + k, sides + k + 1) for k in range(1, sides - 1)]
    return as_obj([(corners, np.array(faces))])


# The built-in upright objects, by family: sides of the base and full extents of boxes and cans,
# metres, before a scene's own scale. Large: 60 to 70 mm for a hand that opens 80 mm.
STANDING: dict[str, tuple[tuple[int, Size], ...]] = {
    "regular": (
        *((4, (0.03, 0.03, 0.08)), (4, (0.04, 0.04, 0.04)), (4, (0.03, 0.05, 0.07))),
        *((10, (0.03, 0.03, 0.08)), (10, (0.04, 0.04, 0.06)), (10, (0.05, 0.05, 0.05))),
    ),
    "large": (
        *((4, (0.065, 0.065, 0.10)), (4, (0.06, 0.09, 0.12)), (4, (0.07, 0.07, 0.07))),
        *((10, (0.06, 0.06, 0.12)), (10, (0.065, 0.065, 0.10)), (10, (0.07, 0.07, 0.08))),
    ),
}
_BLOBS = 12  # random shapes in the built-in set for piles


def _write_builtin(folder: Path) -> None:
    for family, shapes in STANDING.items():
        for number, shape in enumerate(shapes):
            write_object(f"{family}-{number}", _prism(*shape), folder)
    for number in range(_BLOBS):
        blob(number, folder)


def _kept_in(name: str, write: Callable[[Path], None]) -> Path:
    folder = cache_folder() / name
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".unfinished-", dir=folder.parent) as scratch:
        write(unfinished := Path(scratch, name))
        with suppress(OSError):  # another process was faster, with the same result
            unfinished.rename(folder)
    return folder


def _read(mesh: Path) -> Any:
    """The triangles of a file as one mesh; raises ValueError unless they enclose a volume."""
    import trimesh

    try:
        surface: Any = trimesh.load(mesh, force="mesh", process=True, skip_materials=True)
    except Exception as error:  # readers of meshes raise many kinds of errors
        raise ValueError(f"{mesh} cannot be read as a mesh: {error}") from error
    if len(surface.faces) == 0 or surface.extents is None:
        raise ValueError(f"{mesh} contains no triangles; export the object as a triangle mesh")
    flat = not np.isfinite(surface.vertices).all() or min(surface.extents) <= 1e-9
    if not flat:  # not flat along an axis, but it may be a tilted sheet
        sides = surface.bounding_box_oriented.primitive.extents
        flat = min(sides) <= 1e-6 * max(sides)
    if flat:
        raise ValueError(f"{mesh} is not a solid object: its extents are {surface.extents}")
    return surface


def _write_urdf(folder: Path, name: str, visual: str, collision: str, origin: str = "") -> Path:
    """The URDF file of an object, with the names of its meshes; engines set mass and inertia."""
    urdf = folder / f"{name}.urdf"
    urdf.write_text(f"""<?xml version="1.0"?>
<robot name="{name}">
  <link name="base_link">
    <inertial>
      <mass value="{OBJECT_MASS}"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>{origin}
    </inertial>
    <visual><geometry><mesh filename="{visual}.obj"/></geometry></visual>
    <collision><geometry><mesh filename="{collision}.obj"/></geometry></collision>
  </link>
</robot>
""")
    return urdf
