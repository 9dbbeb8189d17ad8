"""Labelled views, written by the data generator and read by the trainer."""

import json
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, compress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from edgegrasp_camera.arrays import Bools, Float32, Int64
from edgegrasp_model.gripper import Gripper, gripper_from_fields, load_gripper
from edgegrasp_model.options import SupportPlane, Workspace
from edgegrasp_model.scene.scene import near_workspace_side

UNTRIED = -1  # label of a candidate that was not tried
TOGETHER = 0.009  # metres; nearer points belong to one object; twice the edge of a voxel
STORED_TYPES = {"normals": np.float16, "approach_index": np.uint16, "contact_index": np.uint16}
# Types to which the arrays of a file are converted.
TYPES: dict[str, Callable[[Any], Any]] = {
    **{"normals": np.float32, "approach_index": np.int64, "contact_index": np.int64},
    **{"engine": str, "sensor": str, "gripper": str, "objects": tuple, "object_digests": tuple},
}
# The table and the limits of the simulated scenes, for files without them.
TABLE = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.05)
WORKSPACE = Workspace(min=(0.02, 0.02, 0.055), max=(0.28, 0.28, 0.3))
UP = np.array([0.0, 0.0, 1.0], dtype=np.float32)


@dataclass(frozen=True)
class LabelledView:
    """One observed cloud and some of its edge grasps, tried in simulation; world frame, metres."""

    points: Float32  # (N, 3) after voxel downsampling
    normals: Float32  # (N, 3) unit, toward the camera
    camera_position: Float32  # (3,)
    approach_index: Int64  # (E,) rows of `points`
    contact_index: Int64  # (E,) rows of `points`
    success: NDArray[np.int8]  # (E,) 1 held after the lift, 0 not, UNTRIED
    engine: str = "pybullet"  # engine that simulated the labels
    gripper: str = ""  # fields of the hand that tried the grasps, JSON; empty: the Panda's hand
    T_world_hand: Float32 | None = None  # (E, 4, 4) hands tried; None: edge grasps of the paper
    firm: NDArray[np.int8] | None = None  # (E,) 1 held after shaking too, 0 not, UNTRIED
    support: Float32 | None = None  # (4,) unit normal and offset; zeros: unknown; None: TABLE
    at_side: Bools | None = None  # (N,) at a cropped side of the cloud; None: from WORKSPACE
    object_of_point: NDArray[np.int16] | None = None  # (N,) -1: on no object; None: unknown
    objects: tuple[str, ...] = ()  # names of the objects in the scene, if known
    object_digests: tuple[str, ...] = ()  # SHA-256 of their files, in the same order
    targets: NDArray[np.str_] | None = None  # (E,) objects between the fingers, "": none
    sensor: str = ""  # kind of depth camera whose faults the cloud has, "": unknown

    def save(self, path: Path) -> None:
        """Write the view; a reader sees the whole file or none."""
        kept = {name: value for name, value in vars(self).items() if value is not None}
        arrays = {name: np.asarray(value, STORED_TYPES.get(name)) for name, value in kept.items()}
        partial = path.with_suffix(".partial")
        with partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        partial.replace(path)

    @property
    def hand(self) -> Gripper:
        """The hand that executed the grasps."""
        fields = self.gripper
        return gripper_from_fields(json.loads(fields)) if fields else load_gripper()

    @property
    def support_plane(self) -> SupportPlane | None:
        """The support plane, given or found; None if unknown."""
        if self.support is None:
            return TABLE
        x, y, z, offset = self.support.astype(np.float64).tolist()
        return SupportPlane(normal=(x, y, z), offset=offset) if (x, y, z) != (0, 0, 0) else None

    @property
    def up(self) -> Float32:
        """Unit vector (3,) away from gravity, as the detector uses it."""
        plane = self.support_plane
        return UP if plane is None else np.asarray(plane.normal, dtype=np.float32)

    def cut_off(self) -> Bools:
        """Which points (N,) are at a side of the workspace, where the cloud is cropped."""
        if self.at_side is not None:
            return self.at_side
        if len(self.points) == 0:
            return np.zeros(0, dtype=bool)
        return near_workspace_side(self.points, WORKSPACE, UP, self.points)

    def numbered_objects(self) -> Int64:
        """The object (N,) that each point belongs to; connected components where unknown."""
        if self.object_of_point is not None:
            return self.object_of_point.astype(np.int64)
        tree = cKDTree(self.points)
        near = tree.sparse_distance_matrix(tree, TOGETHER, output_type="coo_matrix")
        return connected_components(near, directed=False)[1].astype(np.int64)

    def tried(self) -> Int64:
        """Rows of the candidates that have a label."""
        return np.flatnonzero(self.success != UNTRIED)


def load_view(path: Path) -> LabelledView:
    """Read a view; raises ValueError if the file is not a view."""
    fields = LabelledView.__dataclass_fields__
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            stored = {name: arrays[name] for name in arrays if name in fields}
        typed = {name: TYPES.get(name, np.asarray)(value) for name, value in stored.items()}
        return LabelledView(**typed)
    except (TypeError, ValueError, EOFError, BadZipFile) as error:
        raise ValueError(f"data: {path} is not a view ({error}). Remove it") from None


def find_views(folders: list[Path]) -> list[Path]:
    """All view files of some folders, sorted by name; FileNotFoundError if a folder has none."""
    found = {folder: list(folder.glob("*.npz")) for folder in folders}
    if empty := ", ".join(str(folder) for folder, paths in found.items() if not paths):
        raise FileNotFoundError(f"data: no .npz views in {empty}. Run edgegrasp generate-data.")
    return sorted(chain(*found.values()), key=lambda path: path.name)


def scene_of(path: Path) -> str:
    """The scene of a view, from its file name: scene kind, scene number, view."""
    return path.stem.rsplit("_", 1)[0]


def split_by_scene(
    paths: list[Path], validation_share: float, seed: int
) -> tuple[list[Path], list[Path]]:
    """Training and validation views; a scene keeps its part when scenes are added.

    Raises ValueError if no view is left to train on.
    """
    place = [zlib.crc32(f"{seed} {scene_of(path)}".encode()) / 2**32 for path in paths]
    kept = np.array(place) < max(validation_share, min(place) + 2**-32)
    if kept.all():
        raise ValueError(f"data: got {len(set(place))} scenes, all kept for validation. Make more")
    return list(compress(paths, ~kept)), list(compress(paths, kept))


def table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return ["|" + "".join(f" {cell} |" if cell != "" else " |" for cell in line) for line in lines]
