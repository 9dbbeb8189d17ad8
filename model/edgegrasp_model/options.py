"""The options of one detection; every option is defined here.

The command line's flags, the OpenAPI document, the client's types and the documentation's table are
generated from these models; a test checks that the gRPC messages have the same fields.
"""

import base64
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainSerializer,
    StrictBool,
    Tag,
    model_validator,
)

from edgegrasp_model.errors import parse

Tuple = TypeVar("Tuple", bound=tuple[Any, ...])

FARTHEST = 1e7  # metres from the origin along an axis: more than the Earth's radius


def _no_text_or_truth(value: object) -> object:
    """Refuse values that Python would convert to numbers, such as true and "3"."""
    if isinstance(value, bool | str | bytes):
        raise ValueError("must be a number")
    return value


# Must come last in an annotation: pydantic writes wrong schemas for bounds after it.
numeric = BeforeValidator(_no_text_or_truth)
Integer = Annotated[int, numeric]
Number = Annotated[float, numeric]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-FARTHEST, le=FARTHEST), numeric]
Vector = Annotated[tuple[Finite, Finite, Finite], Field(description="x, y, z in the cloud's frame")]
Row = Annotated[int, Field(strict=True, ge=0, lt=2**31)]
GraspId = Annotated[int, Field(strict=True, ge=0, lt=2**30)]
MAX_SHAPES = 64
MAX_ROWS = 5_000_000
ObjectNumbers = Annotated[tuple[Row, ...], Field(max_length=4096)]
Name = Annotated[str, Field(max_length=100)]
Share = Annotated[float, Field(ge=0.0, le=1.0), numeric]
Length = Annotated[float, Field(gt=0.0, le=1000.0), numeric]
HandLength = Annotated[float, Field(gt=0.0, le=1.0), numeric]  # metres
SAME_LENGTH = 1e-6  # metres; lengths of a gripper that differ by less are the same
NearHand = Annotated[float, Field(ge=-1.0, le=1.0), numeric]  # metres
Corner = Annotated[
    tuple[NearHand, NearHand, NearHand], Field(description="x, y, z in the hand frame, metres")
]
MAX_APPROACH_POINTS = 256
MAX_CANDIDATES = 16_000
ApproachPointCount = Annotated[int, Field(ge=1, le=MAX_APPROACH_POINTS), numeric]
CandidateCount = Annotated[int, Field(ge=1, le=MAX_CANDIDATES), numeric]
MAX_VIEWS = 64
MAX_PREVIOUS, MAX_SURFACE = 64, 128  # grasps or objects of an answer; points of an object
APPROACH_STREAM, CANDIDATE_STREAM, SUPPORT_STREAM = range(3)  # streams of random numbers of a seed
CollisionMode = Literal["avoid", "penalise", "ignore"]


def _of_length_one(value: Tuple) -> Tuple:
    if abs(float(np.linalg.norm(value)) - 1.0) > 1e-3:
        raise ValueError("must have length 1")
    return value


def _not_zero(value: Tuple) -> Tuple:
    if float(np.linalg.norm(value)) < 1e-6:
        raise ValueError("must not be the zero vector")
    return value


UnitVector = Annotated[Vector, AfterValidator(_of_length_one)]
Direction = Annotated[Vector, AfterValidator(_not_zero)]
PixelPlace = Annotated[float, Field(ge=-0.5, le=100_000.0), numeric]
Pixel = Annotated[
    tuple[PixelPlace, PixelPlace],
    Field(description="column, row; the centre of the top left pixel is (0, 0)"),
]
Matrix = Annotated[tuple[Finite, ...], Field(min_length=16, max_length=16)]  # row by row
FlatPoints = Annotated[tuple[Finite, ...], Field(max_length=3 * MAX_SURFACE)]  # x, y, z of each
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_of_length_one)]


def _in_one_line(schema: dict[str, Any]) -> None:
    """Remove the docstrings' line breaks from the descriptions of fields."""
    for part in schema.get("properties", {}).values():
        if "description" in part:
            part["description"] = " ".join(part["description"].split())


class Strict(BaseModel):
    """Base of every option object: unknown fields are refused, instances are frozen."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True, json_schema_extra=_in_one_line
    )


def _ordered(corners: Tuple) -> Tuple:
    if not all(low < high for low, high in zip(*corners, strict=True)):
        raise ValueError("every coordinate of min must be below that of max")
    return corners


class Workspace(Strict):
    """An axis-aligned box in the cloud's frame, where grasps may be.

    Points outside remain as obstacles, and the network still sees them.
    """

    min: Vector = Field(description="lower corner, metres")
    max: Vector = Field(description="upper corner, metres")

    @model_validator(mode="after")
    def _min_below_max(self) -> Self:
        _ordered((self.min, self.max))
        return self


class Box(Workspace):
    """An axis-aligned box in the cloud's frame."""

    kind: Literal["box"] = "box"


class OrientedBox(Strict):
    """A box in any orientation."""

    kind: Literal["oriented_box"] = "oriented_box"
    center: Vector = Field(description="centre, metres")
    half_extents: tuple[Length, Length, Length]
    """half lengths along the box's axes, metres"""
    quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)
    """x, y, z, w: turns the box's axes into the cloud's (T_cloud_box)"""


class Sphere(Strict):
    """A ball."""

    kind: Literal["sphere"] = "sphere"
    center: Vector = Field(description="centre, metres")
    radius: Length = Field(description="metres")


class HalfSpace(Strict):
    """Everything on one side of a plane: the points x with normal . x >= offset."""

    kind: Literal["half_space"] = "half_space"
    normal: UnitVector = Field(description="unit, into the region")
    offset: Finite = Field(description="normal . x on the plane, metres")


class Indices(Strict):
    """Points, given by their rows in the cloud as it was sent."""

    kind: Literal["indices"] = "indices"
    indices: tuple[Row, ...] = Field(max_length=MAX_ROWS)
    """rows of the cloud as sent; row-major if organised"""


def _byte_for_each(value: object) -> bytes:
    """Boolean values in any accepted form, as one byte each: 0 or 1."""
    if isinstance(value, (list, tuple)):
        # As objects, since a text array gives every element the size of the longest.
        values: list[Any] = np.array(value, dtype=object).ravel().tolist()
        if set(map(type, values)) <= {bool}:
            return bytes(values)
    elif isinstance(value, np.ndarray) and value.dtype == bool:
        return value.tobytes()
    elif isinstance(value, (str, bytes)):
        sent = base64.b64decode(value, validate=True) if isinstance(value, str) else value
        return np.frombuffer(sent, np.uint8).astype(bool).tobytes()
    raise ValueError("must be a boolean for each row, or base64 of one byte for each row")


class Mask(Strict):
    """Points, given by a boolean for each row of the cloud as it was sent."""

    kind: Literal["mask"] = "mask"
    mask: Annotated[
        bytes,
        Field(max_length=MAX_ROWS),
        PlainSerializer(lambda mask: list(map(bool, mask)), list[bool]),
        BeforeValidator(
            _byte_for_each,
            json_schema_input_type=Annotated[
                str, Field(json_schema_extra={"contentEncoding": "base64"})
            ]
            | Annotated[list[bool], Field(max_length=MAX_ROWS)],
        ),
    ]
    """one value for each row of the cloud; in JSON also base64 of one byte each"""


class Segments(Strict):
    """Points, given by their segments in `segment_ids`, which are sent with the cloud."""

    kind: Literal["segments"] = "segments"
    ids: tuple[Annotated[int, Field(strict=True, ge=-(2**31), lt=2**31)], ...] = Field(
        min_length=1, max_length=4096, description="values of segment_ids"
    )


Rows = Indices | Mask | Segments
Shape = Annotated[Box | OrientedBox | Sphere | HalfSpace | Rows, Field(discriminator="kind")]
Shapes = Annotated[tuple[Shape, ...], Field(max_length=MAX_SHAPES)]


class Region(Strict):
    """Points in any of `include` and in none of `exclude`.

    A shape contains a voxel of the processed cloud if it contains the voxel's mean point. Rows
    (indices, mask, segments) contain a voxel if they contain at least half of its points.
    """

    include: Shapes = Field(default=(), description="union of shapes; empty: everywhere")
    exclude: Shapes = Field(default=(), description="union of shapes to leave out")


class Cone(Strict):
    """Directions within an angle of a given direction."""

    direction: Direction = Field(
        description="direction in which the hand moves, its +z axis; any length but zero"
    )
    max_angle: Annotated[float, Field(ge=0.0, le=math.pi), numeric]
    """greatest angle between `direction` and the hand's +z axis, radians"""


class ApproachDirection(Strict):
    """Directions in which the hand may move: those in any cone or in the preset.

    `top-down` is within 30 degrees of straight down, `side` within 30 degrees of the horizontal,
    both relative to `up`. Without this option, all hands are allowed but those that come from more
    than 6 degrees below the horizontal.
    """

    cones: tuple[Cone, ...] = Field(default=(), max_length=64)
    """a direction in any of these is allowed"""
    preset: Literal["top-down", "side"] | None = None
    """a direction in this is allowed too, relative to up"""

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not self.cones and self.preset is None:
            raise ValueError("give at least one cone or a preset, or leave approach_direction out")
        return self


class SupportPlane(Strict):
    """The plane objects rest on: the points x with normal . x = offset; the normal points up."""

    kind: Literal["plane"] = "plane"
    normal: UnitVector = Field(description="unit normal, away from the table")
    offset: Finite = Field(description="normal . x of its points, metres")
    max_depth_error: Annotated[float, Field(ge=0.0, le=0.3), numeric] = 0.0
    """greatest relative error of a camera's depths: each view is scaled about its viewpoint by at
    most this share, to move its table into the plane; 0: no correction"""


class RansacPlane(Strict):
    """The largest plane in the cloud that is nearly level.

    It is searched within the workspace, with the request's seed. Its points are removed first; the
    plane stays as an obstacle. If none is found, there is a warning and no support plane.
    """

    kind: Literal["ransac"] = "ransac"
    distance: Annotated[float, Field(gt=0.0, le=0.1), numeric] = 0.005
    """points within this distance belong to the plane, metres; it is raised if depths are noisy"""
    max_tilt: Annotated[float, Field(ge=0.0, le=1.6), numeric] = 0.35
    """greatest angle between its normal and up, radians; π/2: any plane"""
    min_share: Annotated[float, Field(gt=0.0, le=1.0), numeric] = 0.1
    """least share of the points that must lie in it"""


class AutoPlane(Strict):
    """The plane through the points near objects that are classified as support.

    If `up` is sent, the plane is level to within 30 degrees. If no plane is seen, there is a
    warning, and one is assumed only if the cloud was cropped above its support. Its normal is then
    `up`, or +z if no camera is at the origin, else estimated from the lower edge of the cloud.
    """

    kind: Literal["auto"] = "auto"


class HandPart(Strict):
    """Boxes of the hand or of one finger, in the hand frame."""

    boxes: tuple[Annotated[tuple[Corner, Corner], AfterValidator(_ordered)], ...] = Field(
        min_length=1, max_length=16, description="[min corner, max corner] each"
    )


class Linkage(Strict):
    """A linkage that carries each finger along an arc; the tips move forward as they close."""

    radius: HandLength = Field(description="length of the link that carries a finger, metres")
    reach: NearHand = Field(description="y of that link in the open gripper, outward, metres")


class GripperGeometry(Strict):
    """A parallel-jaw gripper, as in a gripper file; z towards the object, y the closing axis."""

    name: Name = Field(default="custom", description="shown in results")
    max_opening: HandLength = Field(description="metres between the open fingers' inner faces")
    tip_z: HandLength = Field(description="fingertips of the open gripper, metres along z")
    contact_z: HandLength
    """contact point, metres along z; between palm and fingertips"""
    tcp_z: NearHand = Field(description="origin of the TCP frame, metres along z")
    hand: HandPart = Field(description="the hand without its fingers")
    finger: HandPart
    """one finger, its inner face at y = 0; mirrored for the other"""
    swing: Linkage | None = None
    """how the fingers swing; null: they close in a straight line"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if any(low[1] < 0 for low, _ in self.finger.boxes):
            raise ValueError("finger.boxes must lie outside the inner face: no y below 0")
        if abs(max(high[2] for _, high in self.finger.boxes) - self.tip_z) > SAME_LENGTH:
            raise ValueError("tip_z must be the highest z of finger.boxes")
        if self.swing is not None:
            reach, radius = self.swing.reach, self.swing.radius
            if max(abs(reach), abs(reach - self.max_opening / 2)) >= radius:
                raise ValueError("swing.radius must exceed the reach, open and closed")
        if not self.palm_z < self.contact_z < self.tip_z:
            raise ValueError(f"contact_z must lie between the palm's z, {self.palm_z:g}, and tip_z")
        return self

    @property
    def pad(self) -> tuple[Corner, Corner]:
        """The box of a finger that touches the object."""
        for low, high in self.finger.boxes:
            if low[1] == 0.0 and low[0] < 0.0 < high[0] and low[2] < self.contact_z < high[2]:
                return low, high
        raise ValueError(
            "one of finger.boxes must contain the contact: y from 0, x on both sides of 0, "
            "contact_z within its z"
        )

    @property
    def pad_half_width(self) -> float:
        """Half width of the pad along x, metres."""
        low, high = self.pad
        return max(-low[0], high[0])

    @property
    def palm_z(self) -> float:
        """Highest z of the hand right behind the space between the fingers, metres."""
        (low_x, _, _), (high_x, _, _) = self.pad
        half = self.max_opening / 2
        behind = [
            high[2]
            for low, high in self.hand.boxes
            if low[0] < high_x and high[0] > low_x and low[1] < half and high[1] > -half
        ]
        if not behind:
            raise ValueError("one of hand.boxes must lie behind the space between the fingers")
        return max(behind)


class Suppression(Strict):
    """Drops a grasp that lies within both distances of a better one."""

    translation: Number = Field(default=0.01, ge=0.0, le=1.0)
    """metres between TCPs"""
    rotation: Number = Field(default=0.5, ge=0.0, le=3.2)
    """radians between hands, ignoring a turn by 180 degrees about the approach"""


class Collision(Strict):
    """Collision checks of the hand and its motion: cloud, support plane and obstacles."""

    mode: CollisionMode = "avoid"
    """avoid: grasps whose hand collides are left out; penalise: they are ranked by half their
    score; ignore: collisions are not checked"""
    margin: Number = Field(default=0.0, ge=0.0, le=0.1)
    """metres by which the hand's boxes are grown on every side"""
    opening: HandLength | None = None
    """metres between the fingers during the approach; null: the gripper's maximum"""
    approach_length: Number = Field(default=0.05, ge=0.0, le=1.0)
    """length of the straight approach, metres"""
    retreat_length: Number = Field(default=0.0, ge=0.0, le=1.0)
    """length of the straight retreat, metres"""
    retreat_direction: Literal["back", "up"] = "back"
    """direction of the retreat: back along the approach, or along up"""
    obstacles: tuple[Annotated[Box | OrientedBox, Field(discriminator="kind")], ...] = Field(
        default=(), max_length=64, description="solid boxes in addition to the cloud"
    )

    @property
    def behind(self) -> float:
        """How far behind the grasp the hand moves along its z, metres."""
        retreat = self.retreat_length if self.retreat_direction == "back" else 0.0
        return max(self.approach_length, retreat)


class ObjectChoice(Strict):
    """Some of the detected objects, by their numbers in an answer to the same cloud."""

    include: ObjectNumbers = Field(default=(), description="numbers of objects; empty: all")
    exclude: ObjectNumbers = Field(default=(), description="numbers of objects to leave out")


def _row_by_row(value: object) -> object:
    """The numbers of a matrix as one flat list, sent flat or as rows."""
    nested = isinstance(value, (list, tuple)) and all(isinstance(r, (list, tuple)) for r in value)
    return [number for row in value for number in row] if nested else value  # type: ignore[attr-defined]


def rigid(value: Tuple) -> Tuple:
    """A pose T (4, 4), row by row; raises ValueError unless it is a rotation and a translation."""
    if not are_rigid(np.reshape(value, (1, 4, 4))).all():
        raise ValueError("must be a rotation and a translation, row-major, with last row 0 0 0 1")
    return value


def are_rigid(poses: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which poses T (M, 4, 4) are a rotation and a translation, with last row 0 0 0 1."""
    finite = np.isfinite(poses).all(axis=(1, 2), keepdims=True)
    turn = np.where(finite, poses[:, :3, :3], 0.0).astype(np.float64)
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    last = (np.abs(poses[:, 3] - (0.0, 0.0, 0.0, 1.0)) <= 1e-6).all(axis=1)
    return np.asarray(last & (off <= 1e-3) & (np.linalg.det(turn) > 0))


def _in_threes(value: Tuple) -> Tuple:
    if len(value) % 3:
        raise ValueError("must be three numbers for each point")
    return value


RigidPose = Annotated[
    Matrix,
    AfterValidator(rigid),
    BeforeValidator(_row_by_row, json_schema_input_type=Matrix | list[list[float]]),
]


class PlaceRegion(Workspace):
    """An axis-aligned box in the arm's base frame; the object is put on its bottom."""


class Place(Strict):
    """Where the arm puts the object down: in one pose, or anywhere in a region."""

    T_base_object: RigidPose | None = None
    """pose of the object's box, as in `objects` of the answer, in the arm's base frame: a 4 x 4
    matrix, row by row"""
    region: PlaceRegion | None = None
    """box for the whole object, which may be turned about the vertical; the base frame's z must be
    up"""

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.T_base_object is None) == (self.region is None):
            raise ValueError("must have one of T_base_object and region")
        return self


class RobotArm(Strict):
    """The arm that executes the grasp; each grasp in the answer has its joints and motion."""

    name: Name
    """one of the server's robots"""
    T_base_cloud: RigidPose
    """pose of the cloud's frame in the arm's base frame: a 4 x 4 matrix, row by row"""
    joints: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=16)]
    """the arm's joints now, radians or metres, in the order of the robot file"""
    plan: Literal["reach", "motion"] = "motion"
    """reach: joints at each pregrasp and grasp; motion: also a timed trajectory"""
    place: Place | None = None
    """where to put the object; a grasp is within reach only if this place is too; null: the motion
    ends with the object lifted"""
    avoid_unseen: StrictBool = False
    """whether unseen space behind a surface is an obstacle for the arm"""


class PreviousGrasp(Strict):
    """A grasp of an earlier answer."""

    id: GraspId = Field(description="as in that answer")
    T_cloud_hand: RigidPose = Field(description="as in that answer: a 4 x 4 matrix, row by row")
    object: Row | None = Field(default=None, description="number of the object that it is on")


class PreviousObject(Strict):
    """An object of an earlier answer."""

    number: Row = Field(description="as in that answer")
    surface: Annotated[
        FlatPoints,
        AfterValidator(_in_threes),
        BeforeValidator(_row_by_row, json_schema_input_type=FlatPoints | list[list[float]]),
    ] = Field(description="as in that answer: x, y, z of points on it, one after another, metres")
    confidence: Share | None = Field(default=None, description="as in that answer")


class Previous(Strict):
    """Grasps and objects of an earlier answer, to be followed.

    All coordinates are in the frame of the cloud that is sent now.
    """

    gripper: Name = Field(default="", description="name of the gripper in that answer")
    next_id: GraspId = Field(default=0, description="as in that answer")
    grasps: tuple[PreviousGrasp, ...] = Field(default=(), max_length=MAX_PREVIOUS)
    """best first; the first is the one to keep"""
    objects: tuple[PreviousObject, ...] = Field(default=(), max_length=MAX_PREVIOUS)
    """objects of these grasps, and others"""
    search: StrictBool = True
    """whether to detect other grasps too; false: these are only moved and scored again, in a
    fraction of the time; then also send `normal` and `offset` of that answer's `support`"""

    @property
    def free_id(self) -> int:
        """An id above all ids of grasps and numbers of objects in it; restarts low after 2**29."""
        used = [grasp.id for grasp in self.grasps] + [one.number for one in self.objects]
        free = max([self.next_id, *(1 + one for one in used)])
        return free if free < 2**29 else 1 + max((one for one in used if one < 2**29), default=0)

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        ids, numbers = [grasp.id for grasp in self.grasps], [one.number for one in self.objects]
        for name, used in (("grasps", ids), ("objects", numbers)):
            if len(set(used)) < len(used):
                twice = next(one for one in used if used.count(one) > 1)
                raise ValueError(f"{name} must differ: {twice} is the id of two of them")
        return self


def _one_of_one(value: object) -> object:
    """A list of one vector becomes that vector, so both are the same request."""
    if isinstance(value, (list, tuple)) and len(value) == 1 and isinstance(value[0], (list, tuple)):
        return value[0]
    return value


def _viewpoints(value: object) -> str:
    several = isinstance(value, (list, tuple)) and value and isinstance(value[0], (list, tuple))
    return "several" if several else "one"


def _with_kind(value: object) -> object:
    """A support as an object with its kind, which is `plane` if none is named."""
    if isinstance(value, Mapping):
        return {"kind": "plane", **value}
    if value == "none":
        return None
    return {"kind": value} if isinstance(value, str) else value


text_or_fields = Discriminator(lambda value: "text" if isinstance(value, str) else "fields")
GripperChoice = Annotated[
    Annotated[str, Tag("text")] | Annotated[GripperGeometry, Tag("fields")], text_or_fields
]
ObjectsOption = Annotated[
    Annotated[Literal["auto", "off"], Tag("text")] | Annotated[ObjectChoice, Tag("fields")],
    text_or_fields,
]
Viewpoint = Annotated[
    Annotated[Vector, Tag("one")]
    | Annotated[tuple[Vector, ...], Field(min_length=2, max_length=MAX_VIEWS), Tag("several")],
    Discriminator(_viewpoints),
    BeforeValidator(_one_of_one),
]
Plane = Annotated[SupportPlane | RansacPlane | AutoPlane, Field(discriminator="kind")]
PlaneOrKind = Literal["auto", "ransac", "none"] | SupportPlane | RansacPlane | AutoPlane | None
SupportChoice = Annotated[
    Plane | None, BeforeValidator(_with_kind, json_schema_input_type=PlaneOrKind)
]
CollisionChoice = Annotated[
    Collision,
    BeforeValidator(
        lambda value: {"mode": value} if isinstance(value, str) else value,
        json_schema_input_type=CollisionMode | Collision,
    ),
]


class DetectOptions(Strict):
    """Options of one detection; the defaults suit a tabletop scene seen by one camera."""

    model: str = ""
    """weights to use; empty: the server's default"""
    gripper: GripperChoice | None = None
    """gripper, by name or geometry; null: the one the weights were trained for"""
    num_approach_points: ApproachPointCount | None = None
    """approach points sampled, spread over the objects; null: as many as they need"""
    num_candidates: CandidateCount = 2000
    """candidates scored at most"""
    sampling: Literal["farthest", "uniform"] = "farthest"
    """how approach points are sampled"""
    seed: Integer = Field(default=0, ge=0, lt=2**63)
    """seed of every random choice"""
    viewpoint: Viewpoint | None = None
    """camera position, metres. If there are several, `view_ids` beside the cloud says which one saw
    each point. null: the origin if the whole cloud lies in front of it, else the position above
    the cloud from which the fewest points are hidden"""
    up: Direction | None = None
    """direction away from gravity; any length but zero; null: the support plane's normal; without
    one, an estimate in a camera's frame, else +z"""
    support: SupportChoice = AutoPlane()
    """plane that the objects rest on and the hand stays above; a kind alone is allowed; null:
    none, and no objects are recognised"""
    objects: ObjectsOption = "auto"
    """objects to grasp: those recognised (auto), some of them by number, or everything above the
    support (off); all else is an obstacle. If segment_ids are sent, those above 0 are the
    objects"""
    at: Pixel | None = None
    """pixel of the image; grasps are for the object at this pixel"""
    near: Vector | None = None
    """position, metres; grasps are for the nearest object, at most 0.1 m away"""
    max_object_size: Number = Field(default=0.4, gt=0.0, le=10.0)
    """longest side of an object, metres; larger ones are obstacles"""
    workspace: Workspace | None = None
    """where grasps may be; points outside remain obstacles; null: everywhere"""
    approach_region: Region | None = None
    """where approach points may lie; null: everywhere"""
    contact_region: Region | None = None
    """where contact points may lie; null: everywhere"""
    approach_direction: ApproachDirection | None = None
    """directions in which the hand may move; null: all but from below"""
    collision: CollisionChoice = Collision()
    """collision checks of the hand; a mode alone is allowed"""
    robot: RobotArm | None = None
    """arm that executes the grasp; grasps within its reach come first; null: no arm"""
    min_score: Share = 0.3
    """lowest score returned; 0: all"""
    top_k: CandidateCount = 50
    """grasps returned at most"""
    suppression: Suppression | None = Suppression()
    """non-maximum suppression; null: none"""
    order: Literal["score", "highest", "clearance"] = "score"
    """score: first, for each object with a grasp of 0.5 or more, a grasp among other good grasps;
    then by score, and by the pose of the hand where scores are close. highest: scores of 0.9 or
    more by height of the TCP along up, then the others by score. clearance: by clearance"""
    previous: Previous | None = None
    """grasps and objects of an earlier answer, which keep their ids, numbers and order; an empty
    object for the first image; null: no tracking"""
    debug: StrictBool = False
    """whether to return the processed cloud and every candidate"""

    @property
    def known_up(self) -> NDArray[np.float64] | None:
        """(3,) unit, away from gravity; None if neither `up` nor a support plane is given."""
        plane = self.support.normal if isinstance(self.support, SupportPlane) else None
        known = plane if self.up is None else self.up
        return None if known is None else np.asarray(known) / np.linalg.norm(known)

    @property
    def follows_only(self) -> bool:
        """Whether only the grasps of an earlier answer are wanted."""
        return self.previous is not None and not self.previous.search


def parse_options(fields: object) -> DetectOptions:
    """Build options from decoded JSON; raises InvalidRequest, which names the field."""
    return parse(DetectOptions, fields, "options")
