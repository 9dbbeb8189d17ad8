"""A parallel-jaw gripper, from a small data file or from the same fields in a request."""

import dataclasses
import tomllib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats
from edgegrasp_model.errors import InvalidGripper, InvalidRequest
from edgegrasp_model.options import DetectOptions, GripperGeometry, HandPart, Linkage

GRIPPER_FOLDER = Path(__file__).parent / "grippers"
APPROACH_LENGTH = 0.05  # metres of straight approach that is checked, and described to the network
FINGER_LENGTH = 0.0465  # metres, of the Panda's fingers; the network sees longer ones as this long

# Factors for the columns of a hand's pose that turn the hand by 180 degrees about its z.
HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0], dtype=np.float32)


@dataclasses.dataclass(frozen=True)
class Gripper:
    """Geometry of a gripper in its hand frame: z toward the object, y the closing direction."""

    name: str
    max_opening: float  # metres between the open fingers' inner faces
    tip_z: float  # fingertips of the open gripper, metres along z
    contact_z: float  # where an edge grasp puts its contact point, metres along z
    tcp_z: float  # origin of the TCP frame, metres along z
    palm_z: float  # palm surface between the fingers, metres along z
    pad_half_width: float  # half width along x of the finger's contact pad, metres
    hand: HandPart
    finger: HandPart  # one finger of the open gripper, its inner face at y = 0
    swing: Linkage | None  # None: the fingers close in a straight line

    @cached_property
    def seen_palm_z(self) -> float:
        """The palm's z that the network sees: at most FINGER_LENGTH behind the tips."""
        return max(self.palm_z, self.tip_z - FINGER_LENGTH)

    @cached_property
    def finger_thickness(self) -> float:
        """Metres along y from a finger's inner face to its outer one."""
        return max(high[1] for _, high in self.finger.boxes)

    @cached_property
    def T_hand_tcp(self) -> Float32:  # noqa: N802
        """Maps TCP coordinates to hand coordinates, (4, 4)."""
        transform = np.eye(4, dtype=np.float32)
        transform[2, 3] = self.tcp_z
        return transform

    @cached_property
    def reach(self) -> float:
        """Metres from a contact point to the farthest corner of the open hand."""
        x, y, z = np.abs(self.open_boxes.reshape(-1, 3) - (0.0, 0.0, self.contact_z)).T
        return float(np.sqrt(x**2 + (y + self.max_opening / 2) ** 2 + z**2).max())

    @cached_property
    def symmetric(self) -> bool:
        """Whether the open gripper is the same after half a turn about its z."""
        boxes = self.open_boxes.reshape(-1, 6)
        turned = boxes[:, [3, 4, 2, 0, 1, 5]] * (-1, -1, 1, -1, -1, 1)
        rows, others = (one[np.lexsort(one.round(6).T)] for one in (boxes, turned))
        return bool(np.allclose(rows, others))

    @cached_property
    def max_tip_z(self) -> float:
        """Most forward position of the fingertips while closing, metres along z."""
        return self.tip_z + float(self.furthest_advance(0.0))

    def between_fingers(self, position: Floats) -> Bools:
        """Which points (3, P), hand frame, lie between the pads as the open fingers close."""
        x, y, z = position
        across = (np.abs(x) < self.pad_half_width) & (np.abs(y) < self.max_opening / 2)
        return np.asarray(across & (z > self.palm_z) & (z < self.max_tip_z))

    def tip_advance(self, opening: ArrayLike) -> Floats:
        """Metres along z that the fingertips move between the open gripper and an opening (...)."""
        opening = np.asarray(opening)
        if self.swing is None:
            return np.zeros_like(opening, dtype=np.float64)
        radius, reach = self.swing.radius, self.swing.reach
        outward = reach - (self.max_opening - np.clip(opening, 0.0, self.max_opening)) / 2
        return np.asarray(np.sqrt(radius**2 - outward**2) - np.sqrt(radius**2 - reach**2))

    def furthest_advance(self, opening: ArrayLike) -> Floats:
        """The greatest `tip_advance` while the gripper closes to an opening (...)."""
        reach = 0.0 if self.swing is None else self.swing.reach
        upright = self.max_opening - 2 * reach  # the links point straight ahead there
        return self.tip_advance(np.maximum(opening, upright))

    def contact_z_at(self, opening: ArrayLike) -> Float32:
        """Position of a contact along z, behind the fingertips, at an opening (...); metres."""
        return (self.contact_z + self.tip_advance(opening)).astype(np.float32)

    def boxes(self, opening: float) -> Float64:
        """Boxes with the fingers `opening` metres apart: hand, then both fingers.

        Least and greatest corners (B, 2, 3), hand frame.
        """
        ahead = float(self.tip_advance(opening))
        right = np.add(self.finger.boxes, (0.0, opening / 2, ahead))  # (F, 2, 3)
        left = right.copy()
        left[:, 0, 1], left[:, 1, 1] = -right[:, 1, 1], -right[:, 0, 1]
        return np.concatenate([np.asarray(self.hand.boxes), right, left])

    @cached_property
    def open_boxes(self) -> Float64:
        """`boxes` (B, 2, 3) of the open gripper; copy them before changing them."""
        return self.boxes(self.max_opening)

    def opened_to(self, opening: float) -> "Gripper":
        """The same gripper, opening to at most `opening` metres."""
        ahead = float(self.tip_advance(opening))
        boxes = self.finger.boxes
        forward = tuple(((*a[:2], a[2] + ahead), (*b[:2], b[2] + ahead)) for a, b in boxes)
        swing = self.swing
        if swing is not None:
            reach = swing.reach - (self.max_opening - opening) / 2
            swing = Linkage(radius=swing.radius, reach=reach)
        return dataclasses.replace(
            self,
            max_opening=opening,
            tip_z=self.tip_z + ahead,
            contact_z=self.contact_z + ahead,
            finger=HandPart.model_construct(boxes=forward),
            swing=swing,
        )


def gripper_from_fields(fields: Mapping[str, Any] | GripperGeometry) -> Gripper:
    """Build a gripper from the fields of its file or of a request; raises InvalidGripper."""
    try:
        geometry = GripperGeometry.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        fault, path = first["msg"].removeprefix("Value error, "), first["loc"]
        if path and first["type"] not in ("missing", "extra_forbidden"):
            fault = f"got {repr(first['input'])[:80]}. {fault}"
        field = ".".join(map(str, ("gripper", *path)))
        raise InvalidGripper(f"{field}: {fault}; see grippers/panda.toml.") from None
    return Gripper(*(getattr(geometry, one.name) for one in dataclasses.fields(Gripper)))


def load_gripper(name_or_path: str | Path = "panda") -> Gripper:
    """Load a shipped gripper by name, or a user's own by path; raises InvalidGripper."""
    return gripper_from_fields(gripper_fields(name_or_path))


def gripper_fields(name_or_path: str | Path) -> dict[str, Any]:
    """The fields of a gripper file, ready for JSON and for a request; raises InvalidGripper."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = GRIPPER_FOLDER / f"{name_or_path}.toml"
    if not path.is_file():
        raise InvalidGripper(
            f"gripper: got {str(name_or_path)!r}. Use one of {gripper_names()} or a .toml file."
        )
    try:
        fields = tomllib.loads(path.read_text("utf-8"))
        gripper_from_fields(fields)
        return fields
    except (InvalidGripper, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidGripper(f"{path.name}: {error}") from error


def gripper_names() -> list[str]:
    """Names of the grippers that ship with the package, sorted."""
    return sorted(file.stem for file in GRIPPER_FOLDER.glob("*.toml"))


def choose_gripper(options: DetectOptions, default: Gripper, own: Mapping[str, Gripper]) -> Gripper:
    """The gripper that a request names, `own` ones first, at its opening; raises InvalidRequest."""
    asked = options.gripper
    if asked is None:
        gripper = default
    elif isinstance(asked, GripperGeometry):
        gripper = gripper_from_fields(asked)
    elif asked in own:
        gripper = own[asked]
    elif asked in gripper_names():  # a request must not name a file
        gripper = load_gripper(asked)
    else:
        known = ", ".join(sorted({*own, *gripper_names()}))
        fix = f"Use one of: {known}; or send the gripper itself."
        raise InvalidRequest("options.gripper", repr(asked), fix)
    opening = options.collision.opening
    if opening is None:
        return gripper
    if opening > gripper.max_opening:
        fix = f"Send at most {gripper.max_opening:g} for the gripper {gripper.name!r}."
        raise InvalidRequest("options.collision.opening", f"{opening:g} m", fix)
    return gripper.opened_to(opening)
