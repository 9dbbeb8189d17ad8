"""A hand, floating or on an arm, and a grasp with it: approach, closing, retreat and outcome."""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from edgegrasp_camera.arrays import Float64
from edgegrasp_results import ArmTrajectory
from edgegrasp_sim.engine import TIME_STEP, ArmModel, Contact, Hand, HandModel, Parts, World
from edgegrasp_sim.engine.urdf import parse_obj
from edgegrasp_sim.poses import quaternion_xyzw, translation
from edgegrasp_sim.scene import SceneObject

SHAPES = Path(__file__).parent / "panda_hand.obj"
FINGERTIP = 0.1122  # metres along z from the Panda's panda_hand link
CENTRE = 0.04  # metres along z to the Panda's centre of mass
CLOSE_SECONDS = 0.5
SETTLE_SECONDS = 0.25  # for an arm's joints to settle at the grasp and at the end

# Far above the table and out of view of the cameras.
_PARKED = translation(0.15, 0.15, 5.0)

PREGRASP_DISTANCE = 0.05  # metres back along the approach
RETREAT_DISTANCE = 0.10  # metres
SIDE_GRASP_ANGLE = np.pi / 3  # radians from straight down; beyond it the hand lifts straight up
# The reference moves at 0.10 m/s in pieces of 2 mm and rounds each down to whole steps of 1/80 s.
STEP_LENGTH = 0.002  # metres in each time step
MIN_OPENING = 0.001  # metres; thinner than any object that is held

# Conditions for a clear outcome, after which a grasp may be stopped.
STILL = 5e-5  # metres per time step; fingers at rest close by less
STILL_STEPS = 5
EMPTY_STEPS = 2  # time steps without contact
HELD_STEPS = 4  # time steps in which an object touches only the hand and moves with it
SLIP = 2e-4  # metres per time step; a firmly held object moves in the hand by less
LIFT_STEP = 0.005  # metres in each time step of lifting before shaking: 0.4 m/s
# Depths behind the fingertips, metres, to search for the object between the fingers, best first.
_TARGET_DEPTHS = (0.007, 0.002, 0.015, 0.025)


class FailureCause(StrEnum):
    """Why a grasp failed: the first of these that applies."""

    START_COLLISION = "collision at pre-grasp"
    APPROACH_COLLISION = "collision on approach"
    MISSED = "missed"
    WRONG_OBJECT = "wrong object"
    SLIPPED = "slipped"


@dataclass(frozen=True, slots=True)
class GraspResult:
    """The outcome of a grasp, and its details."""

    opening: float  # metres between the fingers at the end
    start_contact: bool  # whether the open hand overlapped something at its start pose
    held: SceneObject | None  # the object held, None if nothing is
    target: SceneObject | None = None  # the object between the fingers before closing
    cause: FailureCause | None = None  # why it failed, None if it did not
    held_after_shaking: bool | None = None  # None if the hand was not shaken
    # (T, 3) points at which an arm collided before its pregrasp, world frame, metres.
    touched_on_the_way: tuple[Sequence[float], ...] = ()

    @property
    def success(self) -> bool:
        """Whether the hand held an object after the retreat."""
        return self.cause is None


def run_grasp(
    gripper: "HandDriver",  # the hand to use
    T_world_hand: Float64,  # pose of the `panda_hand` link at the grasp, (4, 4)
    objects: Mapping[int, SceneObject],  # objects that may be held, by the id of their bodies
    obstacles: Set[int] = frozenset(),  # bodies; a collision with one fails the grasp
    *,
    to_the_end: bool,  # otherwise stop once the outcome is clear
    shake: bool = False,  # shake a held object at the end; does not change `success`
) -> GraspResult:
    """Run a grasp from its start pose to the end of the retreat; the hand stays there."""
    gripper.start(T_world_hand)
    gripper.world.detect_collisions()
    start_contact = any(contact.distance < 0.0 for contact in gripper.body.contacts())
    target = _object_between_fingers(gripper, T_world_hand, objects)
    touched: list[Sequence[float]] = []

    def result(cause: FailureCause | None, held: SceneObject | None = None) -> GraspResult:
        seen = gripper.body.opening, start_contact, held, target, cause
        return GraspResult(*seen, touched_on_the_way=tuple(touched))

    if any(each.other_uid in obstacles for each in _cut_into(gripper)):
        return result(FailureCause.START_COLLISION)
    collided = False
    for _ in gripper.go(T_world_hand, away=False):
        cut = _cut_into(gripper)
        if gripper.on_the_way:
            touched += [each.position for each in cut]
        if any(each.other_uid in obstacles for each in cut):
            return result(FailureCause.APPROACH_COLLISION)
        collided = collided or bool(cut)
    _close(gripper, objects, to_the_end=to_the_end)
    missed = gripper.is_shut
    caught = _touched(gripper, objects)
    if not missed or to_the_end:
        clear = _outcome_decided(gripper, objects, gripper.body.opening)
        for _ in gripper.go(T_world_hand, away=True):
            if not to_the_end and next(clear):
                break
        held = next(iter(_touched(gripper, objects)), None)
        if held is not None and not gripper.is_shut:
            found = result(None, held)
            if shake:
                still = _holds_when_shaken(gripper, T_world_hand, held, objects)
                found = replace(found, held_after_shaking=still)
            return found
    if start_contact:
        return result(FailureCause.START_COLLISION)
    if collided:
        return result(FailureCause.APPROACH_COLLISION)
    if missed or not caught:
        return result(FailureCause.MISSED)
    wrong = target is not None and target not in caught
    return result(FailureCause.WRONG_OBJECT if wrong else FailureCause.SLIPPED)


def retreat_pose(T_world_hand: Float64) -> Float64:
    """The hand's pose after the retreat: back along the approach, or up after a side grasp."""
    if -T_world_hand[2, 2] < np.cos(SIDE_GRASP_ANGLE):
        return translation(0.0, 0.0, RETREAT_DISTANCE) @ T_world_hand
    return T_world_hand @ translation(0.0, 0.0, -RETREAT_DISTANCE)


class HandDriver:
    """The simulated hand, in the hand frame of its file: z out of the palm, y the closing axis."""

    body: Hand
    motion: ArmTrajectory | None = None  # the arm's motion for the next grasp
    on_the_way = False  # whether the hand is on an arm that has not reached its pregrasp

    def __init__(self, world: World, model: HandModel, min_opening: float) -> None:
        self.world, self.model, self.min_opening = world, model, min_opening
        self._T_hand_com = translation(*model.centre)  # engines set poses of the centre of mass
        self.body = world.add_hand(model, _PARKED[:3, 3])
        self.park()

    @property
    def is_shut(self) -> bool:
        """Whether the fingers are too close to hold anything."""
        return self.body.opening <= self.min_opening

    def park(self) -> None:
        """Move the open hand out of the scene and out of view of the cameras."""
        self.place(_PARKED)

    def start(self, T_world_hand: Float64) -> None:
        """Place the open hand a little behind the grasp."""
        self.place(T_world_hand @ translation(0.0, 0.0, -PREGRASP_DISTANCE))

    def go(self, T_world_hand: Float64, *, away: bool) -> Iterator[None]:
        """Move straight to the grasp, or from it to `retreat_pose`; yields after each time step."""
        return self.steps_to(retreat_pose(T_world_hand) if away else T_world_hand, STEP_LENGTH)

    def place(self, T_world_hand: Float64) -> None:
        """Set the pose of the open hand at once, at rest."""
        T_world_com = T_world_hand @ self._T_hand_com
        self.body.set_pose(T_world_com[:3, 3], quaternion_xyzw(T_world_com))

    def steps_to(self, T_world_hand: Float64, step_length: float) -> Iterator[None]:
        """Pull the hand straight to a pose, `step_length` metres a time step; yields after each."""
        T_world_com = T_world_hand @ self._T_hand_com
        quaternion = quaternion_xyzw(T_world_com)
        position = self.body.position
        way = T_world_com[:3, 3] - position
        distance = float((way @ way) ** 0.5)
        steps = max(1, int(distance / step_length))
        for _ in range(steps):
            position = position + way / steps
            self.body.move(position, quaternion)
            self.world.step()
            yield


class ArmDriver(HandDriver):
    """The hand on an arm."""

    def __init__(self, world: World, hand: HandModel, arm: ArmModel, min_opening: float) -> None:
        self.world, self.model, self.min_opening = world, hand, min_opening
        self.body = self._arm = world.add_arm(arm, hand)

    def park(self) -> None:
        """Set the arm to its home position, with the hand open."""
        self._arm.rest()

    def start(self, T_world_hand: Float64) -> None:
        """Start at home, for any grasp."""
        self.park()

    def go(self, T_world_hand: Float64, *, away: bool) -> Iterator[None]:
        """Follow the motion to the grasp, or away from it; yields after each time step."""
        motion, substeps = self.motion, self._arm.substeps
        if motion is None:
            raise ValueError("the grasp has no motion of the arm; plan it with a robot")
        start, grasp, end = motion.times[[0, motion.grasp_row, -1]]
        begin, end = (grasp, end) if away else (start, grasp)
        for step in range(int(np.ceil((end - begin + SETTLE_SECONDS) / TIME_STEP))):
            times = begin + (step + np.arange(1, substeps + 1) / substeps) * TIME_STEP
            times = times.clip(max=end)
            rows = [
                np.column_stack([np.interp(times, motion.times, joint) for joint in table.T])
                for table in (motion.positions, motion.velocities)
            ]
            self._arm.drive(*rows)
            self.world.step()
            self.on_the_way = bool(times[-1] < motion.times[motion.pregrasp_row])
            yield


def motion_seconds(motion: ArmTrajectory) -> float:
    """Seconds of the motion from home to the grasp, away from it, and home on the same path."""
    return float(motion.times[-1] + motion.times[motion.pregrasp_row]) + CLOSE_SECONDS


@cache
def panda() -> HandModel:
    """The Panda's hand, from the convex hulls of its meshes; its palm is at z = 0.0658 metres."""
    shapes = dict(parse_obj(SHAPES.read_text()))
    finger = shapes["finger"].points
    return HandModel(
        palm=(shapes["palm"].points,),
        fingers=((finger,), (finger * (-1.0, -1.0, 1.0),)),
        finger_base=0.0584,
        finger_centre=(0.0, 0.01, 0.02),
        tip=FINGERTIP,
        centre=(0.0, 0.0, CENTRE),
        max_opening=0.08,
        meshes=("hand.obj", "finger.obj"),
    )


def hand_model(gripper: Mapping[str, Any]) -> HandModel:
    """The hand of boxes described by the fields of a valid gripper file, see docs/frames.md."""
    palm, finger = (np.array(gripper[part]["boxes"], float) for part in ("hand", "finger"))
    opening, root = float(gripper["max_opening"]), float(finger[:, 0, 2].min())
    finger[..., 2] -= root
    centre, finger_centre = (
        ((boxes.min(axis=(0, 1)) + boxes.max(axis=(0, 1))) / 2).tolist() for boxes in (palm, finger)
    )
    advance, held = None, 0.0
    if (swing := gripper.get("swing")) is not None:  # fit the circle to a hundredth of its reach
        radius, reach, half = swing["radius"], swing["reach"], np.linspace(0.0, opening / 2, 50)
        ahead = np.sqrt(radius**2 - (reach - opening / 2 + half) ** 2)
        ahead -= np.sqrt(radius**2 - reach**2)
        fit = np.polynomial.Polynomial.fit(half, ahead, 4).convert()
        advance, held = tuple(fit.coef.tolist()), float(fit(opening / 4))
    return HandModel(
        palm=_corners(palm),
        fingers=(_corners(finger), _corners(finger * (1.0, -1.0, 1.0))),
        finger_base=root,
        finger_centre=finger_centre,
        tip=float(gripper["tip_z"]) + held,
        centre=centre,
        max_opening=opening,
        advance=advance,
    )


def _corners(boxes: Float64) -> Parts:
    """The eight corners (8, 3) of each box (B, 2, 3)."""
    pick = np.indices((2, 2, 2)).reshape(3, 8).T  # lower or upper, of x, y and z
    return tuple(box[pick, np.arange(3)] for box in boxes)


def _close(gripper: HandDriver, objects: Mapping[int, SceneObject], *, to_the_end: bool) -> None:
    """Close the fingers; unless `to_the_end`, stop when they are shut or hold firmly."""
    opening, still_steps = gripper.body.opening, 0
    gripper.body.close_fingers()
    for _ in range(round(CLOSE_SECONDS / TIME_STEP)):
        gripper.world.step()
        before, opening = opening, gripper.body.opening
        still_steps = still_steps + 1 if abs(opening - before) < STILL else 0
        held = still_steps >= STILL_STEPS and _touched(gripper, objects)
        if not to_the_end and (gripper.is_shut or held):
            return


def _outcome_decided(
    gripper: HandDriver, objects: Mapping[int, SceneObject], opening: float
) -> Iterator[bool]:
    """Yields, after every time step of a retreat, whether the outcome is clear.

    It is clear if the fingers are empty, or hold one object that touches nothing else.
    """
    hand, empty_steps, held_steps = gripper.body, 0, 0
    offset: Float64 | None = None
    while True:
        touched = _touched(gripper, objects)
        before, opening = opening, hand.opening
        closing = abs(opening - before) >= STILL  # fingers that may still catch an object
        empty_steps = 0 if touched or closing else empty_steps + 1
        held = touched[0].body if len(touched) == 1 else None
        if held is None or any(contact.other_uid != hand.uid for contact in held.contacts()):
            held_steps = 0
        else:
            was, offset = offset, held.position - hand.position
            slips = was is not None and np.linalg.norm(offset - was) >= SLIP
            held_steps = 0 if slips else held_steps + 1
        yield gripper.is_shut or empty_steps >= EMPTY_STEPS or held_steps >= HELD_STEPS


def _holds_when_shaken(
    gripper: HandDriver,
    T_world_hand: Float64,
    held: SceneObject,
    objects: Mapping[int, SceneObject],
) -> bool:
    """Shake the lifted hand; returns whether it still holds the object."""
    world = gripper.world
    T_world_lifted = retreat_pose(T_world_hand)
    moves = [(T_world_lifted, LIFT_STEP)]
    for along in np.eye(3)[:2]:
        for way in (world.shake_distance, -world.shake_distance, 0.0):
            moves.append((T_world_lifted @ translation(*(way * along)), world.shake_step))
    for T_world_next, step_length in moves:
        for _ in gripper.steps_to(T_world_next, step_length):
            pass
    return not gripper.is_shut and held in _touched(gripper, objects)


def _cut_into(gripper: HandDriver) -> list[Contact]:
    contacts, depth = gripper.body.contacts(), gripper.world.collision_depth
    return [each for each in contacts if each.distance < -depth]


def _touched(gripper: HandDriver, objects: Mapping[int, SceneObject]) -> list[SceneObject]:
    """The objects in contact with the hand, in the order of the contacts."""
    uids = [contact.other_uid for contact in gripper.body.contacts()]
    return [objects[uid] for uid in dict.fromkeys(uids) if uid in objects]


def _object_between_fingers(
    gripper: HandDriver, T_world_hand: Float64, objects: Mapping[int, SceneObject]
) -> SceneObject | None:
    """The object between the fingers at the grasp: the first hit by rays from finger to finger."""
    half, depths = 0.5 * gripper.model.max_opening, [gripper.model.tip - d for d in _TARGET_DEPTHS]
    ends = np.array([[0.0, side * half, z, 1.0] for z in depths for side in (1, -1)])
    rays = ((each @ T_world_hand.T)[:, :3] for each in (ends, ends * (1.0, -1.0, 1.0, 1.0)))
    return next((objects[uid] for uid in gripper.world.first_hits(*rays) if uid in objects), None)
