"""Labelled views: what a data generator writes and a trainer reads."""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

UNTRIED = -1  # label of a candidate that no simulated hand has tried


@dataclass(frozen=True)
class LabelledView:
    """One observed cloud and some of its edge grasps, tried in simulation; world frame, metres."""

    points: Float32  # (N, 3) voxelised
    normals: Float32  # (N, 3) unit, turned to the camera
    camera_position: Float32  # (3,)
    approach_index: NDArray[np.int64]  # (E,) rows of `points`
    contact_index: NDArray[np.int64]  # (E,) rows of `points`
    T_world_hand: Float32 | None  # (E, 4, 4) hands tried; None: those of the paper's definition
    success: NDArray[np.int8]  # (E,) 1 held after the lift, 0 not, UNTRIED
    firm: NDArray[np.int8] | None = None  # (E,) 1 held after shaking too, 0 not, UNTRIED
    objects: tuple[str, ...] = ()  # names of the objects in the scene, where they are known
    object_digests: tuple[str, ...] = ()  # SHA-256 of their files, in the same order

    def save(self, path: Path) -> None:
        """Write the view; a reader sees the whole file or none."""
        arrays: dict[str, NDArray[Any]] = {
            "points": self.points,
            "normals": self.normals.astype(np.float16),
            "camera_position": self.camera_position,
            "approach_index": self.approach_index.astype(np.uint16),
            "contact_index": self.contact_index.astype(np.uint16),
            "success": self.success,
        }
        if self.T_world_hand is not None:
            arrays["T_world_hand"] = self.T_world_hand
        if self.firm is not None:
            arrays["firm"] = self.firm
        if self.objects:
            arrays["objects"] = np.array(self.objects)
            arrays["object_digests"] = np.array(self.object_digests)
        partial = path.with_suffix(".partial")
        with partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        partial.replace(path)

    def tried(self) -> NDArray[np.int64]:
        """Rows of the candidates that have a label."""
        return np.flatnonzero(self.success != UNTRIED)


def load_view(path: Path) -> LabelledView:
    """Read a view."""
    with np.load(path, allow_pickle=False) as arrays:
        return LabelledView(
            points=arrays["points"].astype(np.float32),
            normals=arrays["normals"].astype(np.float32),
            camera_position=arrays["camera_position"].astype(np.float32),
            approach_index=arrays["approach_index"].astype(np.int64),
            contact_index=arrays["contact_index"].astype(np.int64),
            T_world_hand=arrays.get("T_world_hand"),
            success=arrays["success"].astype(np.int8),
            firm=arrays.get("firm"),
            objects=_texts(arrays.get("objects")),
            object_digests=_texts(arrays.get("object_digests")),
        )


def _texts(array: NDArray[np.str_] | None) -> tuple[str, ...]:
    return () if array is None else tuple(str(text) for text in array)


def find_views(folders: list[Path]) -> list[Path]:
    """All view files of some folders, sorted by name.

    Raises:
        FileNotFoundError: There is none.
    """
    paths = [path for folder in folders for path in folder.glob("*.npz")]
    if not paths:
        names = ", ".join(str(folder) for folder in folders)
        raise FileNotFoundError(f"data: no .npz views in {names}. Run edgegrasp generate-data.")
    return sorted(paths, key=lambda path: path.name)


def scene_of(path: Path) -> str:
    """The scene a view shows: its file name is scene kind, scene number, view."""
    return path.stem.rsplit("_", 1)[0]


def split_by_scene(
    paths: list[Path], validation_share: float, seed: int
) -> tuple[list[Path], list[Path]]:
    """Training and validation views; all views of one scene fall on the same side.

    A scene keeps its side when more scenes are added, so that a run may go on with more data.

    Args:
        paths: View files.
        validation_share: Share of the scenes to hold out; at least one is.
        seed: Which ones.
    """
    place = {
        scene: zlib.crc32(f"{seed} {scene}".encode()) / 2**32 for scene in map(scene_of, paths)
    }
    limit = max(validation_share, min(place.values()) + 2**-32)
    return (
        [path for path in paths if place[scene_of(path)] >= limit],
        [path for path in paths if place[scene_of(path)] < limit],
    )


def part_of(paths: list[Path], share: float, seed: int) -> list[Path]:
    """The views of a share of the scenes; a larger share has those of a smaller one too.

    Args:
        paths: View files.
        share: Of the scenes, about; 1: all.
        seed: Which ones.

    Raises:
        ValueError: No view is left.
    """
    part = [p for p in paths if zlib.crc32(f"part {seed} {scene_of(p)}".encode()) < share * 2**32]
    if not part:
        raise ValueError(f"training_share: {share:g} of {len(paths)} views leaves none. Use more.")
    return part
