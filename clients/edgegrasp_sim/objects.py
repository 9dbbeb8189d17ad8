"""Object sets: folders of URDF files, and a set made from what ships with PyBullet."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pybullet_data

from edgegrasp_sim.meshes import MESH_SUFFIXES, prepare_mesh

if TYPE_CHECKING:
    import numpy as np


class SceneKind(StrEnum):
    """How a scene is made: objects stood upright one by one, or dropped on a heap."""

    PACKED = "packed"
    PILE = "pile"


@dataclass(frozen=True, slots=True)
class ObjectModel:
    """An object that can be put into a scene.

    Attributes:
        name: unique within its set.
        urdf: its description.
        scale: factor that brings it to the size of the hand, before a scene's own scale.
        origin: the object that it is another shape of, if it is one.
    """

    name: str
    urdf: Path
    scale: float = 1.0
    origin: ObjectModel | None = None

    @property
    def files(self) -> list[Path]:
        """Its description and the meshes that it names, sorted by name."""
        meshes = ElementTree.parse(self.urdf).iter("mesh")
        named = {self.urdf.parent / mesh.get("filename", "") for mesh in meshes}
        return sorted({self.urdf} | {path for path in named if path.is_file()})

    @property
    def digest(self) -> str:
        """SHA-256 of its files, in hex."""
        contents = [hashlib.sha256(file.read_bytes()).digest() for file in self.files]
        return hashlib.sha256(b"".join(contents)).hexdigest()


@dataclass(frozen=True, slots=True)
class ObjectSet:
    """Objects to draw scenes from.

    Attributes:
        name: what to call the set in a report.
        models: at least one, in an order that is the same on every machine.
    """

    name: str
    models: tuple[ObjectModel, ...]

    def __post_init__(self) -> None:
        if not self.models:
            raise ValueError(f"object set {self.name!r} is empty; pass at least one object")

    def sample(self, rng: np.random.Generator) -> ObjectModel:
        """Draw one object, uniformly."""
        return self.models[int(rng.integers(len(self.models)))]

    @classmethod
    def from_folder(cls, root: Path, scene: SceneKind, split: str = "test") -> ObjectSet:
        """The objects of a folder, sorted by name.

        These are the URDF files in `<root>/<scene>/<split>` (VGN's layout), or in `root` itself
        where there is no such folder. Where there are none, they are the meshes there, `.obj` or
        `.stl`: see `prepare_mesh`.

        Raises:
            FileNotFoundError: there is no such folder, or nothing of the kind in it.
            ValueError: two meshes have one name, or one cannot be used.
            RuntimeError: there are meshes, and what prepares them is not installed.
        """
        folder, name = root / scene / split, f"{scene}/{split}"
        if not folder.is_dir():
            folder, name = root, root.name
        urdfs = sorted(folder.glob("*.urdf"))
        if urdfs:
            return cls(name, tuple(ObjectModel(path.stem, path) for path in urdfs))
        files = folder.iterdir() if folder.is_dir() else ()
        meshes = sorted(path for path in files if path.suffix.lower() in MESH_SUFFIXES)
        if not meshes:
            raise FileNotFoundError(
                f"no *.urdf, *.obj or *.stl files in {folder}; an object folder holds "
                "<scene>/<split>/<name>.urdf with scene packed or pile and split train or test, "
                "or the files themselves"
            )
        names = [path.stem for path in meshes]
        if twice := sorted({each for each in names if names.count(each) > 1}):
            raise ValueError(f"{folder} holds several meshes named {', '.join(twice)}; keep one")
        models = [ObjectModel(path.stem, prepare_mesh(path)) for path in meshes]
        return cls(name, tuple(models))

    @classmethod
    def builtin(cls, scene: SceneKind) -> ObjectSet:
        """Graspable objects that ship with PyBullet, scaled to the hand."""
        root = Path(pybullet_data.getDataPath())
        models = tuple(
            ObjectModel(name, root / file, scale)
            for name, file, scale, stands in _BUILTIN
            if stands or scene is SceneKind.PILE
        )
        return cls(f"builtin/{scene}", models)


def _blob(number: int, scale: float, *, stands: bool) -> tuple[str, str, float, bool]:
    name = f"{number:03d}"
    return f"blob_{name}", f"random_urdfs/{name}/{name}.urdf", scale, stands


# Name, file under pybullet_data, scale, and whether it stands upright in a packed scene.
_BUILTIN: tuple[tuple[str, str, float, bool], ...] = (
    ("cube", "cube_small.urdf", 1.2, True),
    ("brick", "lego/lego.urdf", 2.0, True),
    ("mug", "objects/mug.urdf", 0.8, True),
    ("domino", "domino/domino.urdf", 2.4, True),
    ("jenga", "jenga/jenga.urdf", 0.9, False),
    ("block", "block.urdf", 1.5, False),
    ("duck", "duck_vhacd.urdf", 1.0, False),
    ("teddy", "teddy_vhacd.urdf", 1.0, False),
    _blob(3, 1.0, stands=True),
    _blob(8, 0.8, stands=True),
    _blob(21, 1.0, stands=True),
    _blob(36, 1.1, stands=True),
    _blob(41, 0.8, stands=True),
    _blob(45, 1.0, stands=True),
    _blob(51, 1.0, stands=True),
    _blob(61, 1.0, stands=True),
    _blob(0, 0.75, stands=False),
    _blob(2, 0.75, stands=False),
    _blob(9, 1.2, stands=False),
    _blob(14, 1.1, stands=False),
    _blob(16, 0.8, stands=False),
    _blob(39, 0.75, stands=False),
    _blob(59, 0.8, stands=False),
    _blob(66, 0.8, stands=False),
)
