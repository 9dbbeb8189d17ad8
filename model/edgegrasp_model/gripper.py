"""A parallel-jaw gripper as a small data file, or as the same fields in a request."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError, model_validator

from edgegrasp_model.errors import InvalidGripper
from edgegrasp_model.option_types import Number, Strict, numeric, ordered

GRIPPER_FOLDER = Path(__file__).parent / "grippers"

SAME = 1e-6  # metres below which two lengths of a file are the same

Corner = Annotated[
    tuple[
        Annotated[float, Field(ge=-1.0, le=1.0), numeric],
        Annotated[float, Field(ge=-1.0, le=1.0), numeric],
        Annotated[float, Field(ge=-1.0, le=1.0), numeric],
    ],
    Field(description="x, y, z in the hand frame, metres"),
]
Boxes = tuple[tuple[Corner, Corner], ...]  # (min corner, max corner) each
Length = Annotated[float, Field(gt=0.0, le=1.0), numeric]


class HandPart(Strict):
    """Boxes of the hand or of one finger, hand frame."""

    boxes: Boxes = Field(min_length=1, max_length=16, description="[min corner, max corner] each")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for low, high in self.boxes:
            ordered(low, high)
        return self


class Linkage(Strict):
    """A linkage that carries each finger along an arc: its tips come forward as it closes."""

    radius: Length = Field(description="length of the link that carries a finger, metres")
    reach: Number = Field(
        ge=-1.0, le=1.0, description="outward part (y) of that link in the open gripper, metres"
    )


class GripperGeometry(Strict):
    """A parallel-jaw gripper; the fields of a gripper file. z toward the object, y closing."""

    name: str = Field(default="custom", max_length=100, description="shown in results")
    max_opening: Length = Field(description="metres between the open fingers' inner faces")
    tip_z: Length = Field(description="fingertips of the open gripper, metres along z")
    contact_z: Length = Field(
        description="where contacts are put, metres along z; between palm and fingertips"
    )
    tcp_z: Number = Field(ge=-1.0, le=1.0, description="origin of the TCP frame, metres along z")
    hand: HandPart = Field(description="the hand without its fingers")
    finger: HandPart = Field(description="one finger, its inner face at y = 0; mirrored")
    swing: Linkage | None = Field(
        default=None, description="how the fingers swing; null: they close in a straight line"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if any(low[1] < 0 for low, _ in self.finger.boxes):
            raise ValueError("finger.boxes lie outside of the inner face: no y below 0")
        if abs(max(high[2] for _, high in self.finger.boxes) - self.tip_z) > SAME:
            raise ValueError("tip_z must be the highest z of finger.boxes")
        if _pad(self.finger.boxes, self.contact_z) is None:
            raise ValueError(
                "one of finger.boxes must hold the contact: its y from 0, its x on both sides of "
                "0, contact_z within its z"
            )
        if self.swing is not None:
            reach, radius = self.swing.reach, self.swing.radius
            if max(abs(reach), abs(reach - self.max_opening / 2)) >= radius:
                raise ValueError("swing.radius must exceed the reach, open and closed")
        palm = _palm_z(self)
        if palm is None:
            raise ValueError("one of hand.boxes must lie behind the space between the fingers")
        if not palm < self.contact_z < self.tip_z:
            raise ValueError(f"contact_z must lie between the palm's z, {palm:g}, and tip_z")
        return self


@dataclass(frozen=True)
class Gripper:
    """Geometry of a gripper in its hand frame: z toward the object, y the closing direction."""

    name: str
    max_opening: float  # metres between the open fingers' inner faces
    tip_z: float  # fingertips of the open gripper, metres along z
    contact_z: float  # where an edge grasp puts its contact point, metres along z
    tcp_z: float  # origin of the TCP frame, metres along z
    palm_z: float  # the hand's surface behind the space between the fingers, metres along z
    pad_half_width: float  # half extent along x of the part of a finger that touches, metres
    hand_boxes: Boxes
    finger_boxes: Boxes  # one finger of the open gripper, its inner face at y = 0
    swing: Linkage | None = None

    @cached_property
    def T_hand_tcp(self) -> NDArray[np.float32]:  # noqa: N802
        """Maps TCP coordinates to hand coordinates.  # (4, 4)."""
        transform = np.eye(4, dtype=np.float32)
        transform[2, 3] = self.tcp_z
        return transform

    @property
    def finger_depth(self) -> float:
        """Greatest distance a contact can lie in front of the palm (the paper's G_d), metres."""
        return self.contact_z - self.palm_z

    @cached_property
    def foremost_z(self) -> float:
        """The furthest the fingertips come as they close, metres along z."""
        if self.swing is None:
            return self.tip_z
        upright = self.max_opening - 2 * self.swing.reach  # opening at which the links point ahead
        return self.tip_z + float(self.tip_advance(upright))

    def tip_advance(self, opening: ArrayLike) -> NDArray[np.floating]:
        """How far the fingertips are ahead of where they are in the open gripper, metres.

        Args:
            opening: (...) metres between the fingers.

        Returns:
            (...) metres along z; 0 for fingers that close in a straight line.
        """
        opening = np.asarray(opening)
        if self.swing is None:
            return np.zeros_like(opening, dtype=np.float64)
        radius, reach = self.swing.radius, self.swing.reach
        outward = reach - (self.max_opening - np.clip(opening, 0.0, self.max_opening)) / 2
        advance: NDArray[np.floating] = np.sqrt(radius**2 - outward**2) - np.sqrt(
            radius**2 - reach**2
        )
        return advance

    def contact_z_at(self, opening: ArrayLike) -> NDArray[np.float32]:
        """Where a contact lies along z once the fingers have closed to an opening.

        Always the same distance inside the fingertips, which a swinging finger brings forward.

        Args:
            opening: (...) metres between the fingers as they touch.

        Returns:
            (...) metres along z.
        """
        return (self.contact_z + self.tip_advance(opening)).astype(np.float32)

    def boxes(self, opening: ArrayLike, advance: ArrayLike | None = None) -> NDArray[np.float64]:
        """All boxes with the fingers `opening` metres apart: hand, then both fingers.

        Args:
            opening: (...) metres.
            advance: (...) metres the fingertips are ahead, where not as the opening has it.

        Returns:
            (..., B, 2, 3) min and max corners, hand frame.
        """
        opening = np.asarray(opening, dtype=np.float64)
        ahead = self.tip_advance(opening) if advance is None else np.asarray(advance)
        shift = np.stack(np.broadcast_arrays(np.float64(0.0), opening / 2, ahead), axis=-1)
        right = np.asarray(self.finger_boxes) + shift[..., None, None, :]  # (..., F, 2, 3)
        left = right.copy()
        left[..., 0, 1], left[..., 1, 1] = -right[..., 1, 1], -right[..., 0, 1]
        hand = np.broadcast_to(np.asarray(self.hand_boxes), (*opening.shape, *self._hand_shape))
        return np.concatenate([hand, right, left], axis=-3)

    def opened_to(self, opening: float) -> "Gripper":
        """The same gripper where it opens no further than to `opening` metres."""
        ahead = float(self.tip_advance(opening))
        forward = tuple(
            ((low[0], low[1], low[2] + ahead), (high[0], high[1], high[2] + ahead))
            for low, high in self.finger_boxes
        )
        swing = self.swing
        if swing is not None:
            reach = swing.reach - (self.max_opening - opening) / 2
            swing = Linkage(radius=swing.radius, reach=reach)
        return replace(
            self,
            max_opening=opening,
            tip_z=self.tip_z + ahead,
            contact_z=self.contact_z + ahead,
            finger_boxes=forward,
            swing=swing,
        )

    @property
    def _hand_shape(self) -> tuple[int, int, int]:
        return len(self.hand_boxes), 2, 3


def gripper_from_fields(fields: Mapping[str, Any] | GripperGeometry) -> Gripper:
    """Build a gripper from the fields of a gripper file, as they also come in a request.

    Raises:
        InvalidGripper: A field is missing, unknown or out of range, or they contradict each other.
    """
    try:
        geometry = GripperGeometry.model_validate(fields)
    except ValidationError as error:
        raise InvalidGripper(f"gripper{_first_fault(error)}; see grippers/panda.toml.") from None
    palm_z, pad = _palm_z(geometry), _pad(geometry.finger.boxes, geometry.contact_z)
    assert palm_z is not None
    assert pad is not None
    return Gripper(
        name=geometry.name,
        max_opening=geometry.max_opening,
        tip_z=geometry.tip_z,
        contact_z=geometry.contact_z,
        tcp_z=geometry.tcp_z,
        palm_z=palm_z,
        pad_half_width=max(-pad[0][0], pad[1][0]),
        hand_boxes=geometry.hand.boxes,
        finger_boxes=geometry.finger.boxes,
        swing=geometry.swing,
    )


def load_gripper(name_or_path: str | Path = "panda") -> Gripper:
    """Load a gripper that ships with the package by name, or a user's own by path.

    Raises:
        InvalidGripper: There is no such file, or it is no gripper's.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = GRIPPER_FOLDER / f"{name_or_path}.toml"
    if not path.is_file():
        raise InvalidGripper(
            f"gripper: got {str(name_or_path)!r}. Use one of {gripper_names()} or a .toml file."
        )
    try:
        return gripper_from_fields(tomllib.loads(path.read_text()))
    except (InvalidGripper, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidGripper(f"{path.name}: {error}") from error


def gripper_names() -> list[str]:
    """Names of the grippers that ship with the package, sorted."""
    return sorted(file.stem for file in GRIPPER_FOLDER.glob("*.toml"))


def _pad(boxes: Boxes, contact_z: float) -> tuple[Corner, Corner] | None:
    """The box of a finger that touches the object."""
    for low, high in boxes:
        if low[1] == 0.0 and low[0] < 0.0 < high[0] and low[2] < contact_z < high[2]:
            return low, high
    return None


def _palm_z(geometry: GripperGeometry) -> float | None:
    """Highest z of the boxes behind the space between the fingers; a bracket beside it is none."""
    pad = _pad(geometry.finger.boxes, geometry.contact_z)
    half = geometry.max_opening / 2
    return max(
        (
            high[2]
            for low, high in geometry.hand.boxes
            if pad is not None and low[0] < pad[1][0] and high[0] > pad[0][0]
            if low[1] < half and high[1] > -half
        ),
        default=None,
    )


def _first_fault(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    path = "".join(f".{part}" for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("missing", "extra_forbidden") or not path:
        return f"{path}: {message}"
    return f"{path}: got {repr(first['input'])[:80]}. {message}"
