"""Which grasps an arm reaches, and its motion to them: inverse kinematics, paths, trajectories."""

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice, pairwise
from typing import NamedTuple

import numpy as np
from roboplan import core
from roboplan.rrt import RRT, RRTOptions
from roboplan.toppra import PathParameterizerTOPPRA, SplineFittingMode, TOPPRAOptions

from edgegrasp_camera.arrays import Float64, Floats
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import HALF_TURN
from edgegrasp_model.options import DetectOptions, Place, RobotArm
from edgegrasp_model.results import Following
from edgegrasp_model.scene.cloud import CanonicalFrame, unit
from edgegrasp_model.scene.obstacles import SolidBoxes
from edgegrasp_model.scene.scene import Scene
from edgegrasp_results import ArmPlan, ArmTrajectory, DetectedObject, Detection, Grasp
from edgegrasp_robot.held_object import HeldPoints, build_load, can_leave, held_points, places_for
from edgegrasp_robot.obstacles import HELD_NAME, ArmObstacles, Load, arm_obstacles, scene_with_load
from edgegrasp_robot.robot import GROUP, Robot

MAX_TRIED = 200  # most grasps that are tried with the arm, in their order
MAX_PLACES = 6  # in a region, that are tried with the arm for one grasp
MIN_LEVEL = 0.9  # least cosine between the base's z and up at which a region is allowed
EXTRA_GRASPS = 4  # grasps tried beyond top_k, as some may get no motion
LINE_STEP = 0.025  # metres between poses of a straight motion
MAX_JUMP = 1.0  # most radians that a joint turns between two of these poses
MAX_OFF_LINE = 0.002  # most metres between the hand and its straight line
LIMIT_SHARE = 0.99  # share of the limits that is used, as splines overshoot a little
STEP_SECONDS = 0.01  # seconds between the rows of a trajectory
TRAJECTORY_CHECK_STEP = 0.005  # radians between the joints that are checked along a trajectory
PATH_CHECK_STEP = 0.03  # along a path; finer if its trajectory touches something after all
PATH_SECONDS = 1.0  # for a request's searches that find no path; others take milliseconds
LIMIT_SLACK = 1e-3  # radians or metres by which encoders may be beyond a limit
IK_RESTARTS = 2  # of the inverse kinematics, from random joints
TRAVEL_COST = 0.02  # cost, as a share of a score, per radian of the joint that turns most
FAILURES = ["out_of_reach", "arm_collision", "no_place"]  # the last that applies is counted
NO_REACH = "no grasp is within the arm's reach; see counts."


def options_for_robot(options: DetectOptions, robot: Robot) -> DetectOptions:
    """The options for the detection that `plan_picks` chooses from; raises InvalidRequest."""
    robot_option = options.robot
    assert robot_option is not None
    count = len(robot.joint_names)
    if len(robot_option.joints) != count:
        fix = f"Send {count}: {', '.join(robot.joint_names)}."
        raise InvalidRequest("options.robot.joints", f"{len(robot_option.joints)} numbers", fix)
    joints = np.array(robot_option.joints)
    beyond = (joints < robot.lower - LIMIT_SLACK) | (joints > robot.upper + LIMIT_SLACK)
    for row in np.flatnonzero(beyond):
        low, high = robot.lower[row], robot.upper[row]
        fix = f"{robot.joint_names[row]} moves between {low:g} and {high:g}: send where it is."
        raise InvalidRequest(f"options.robot.joints.{row}", f"{joints[row]:g}", fix)
    if options.collision.mode == "ignore":
        fix = "Send avoid or penalise: an arm needs collision-free hands."
        raise InvalidRequest("options.collision.mode", "'ignore' beside a robot", fix)
    if options.gripper not in (None, robot.gripper.name):
        fix = f"Leave it out: the robot {robot.name!r} has a {robot.gripper.name!r}."
        raise InvalidRequest("options.gripper", "another gripper than the robot's", fix)
    changes = {"top_k": max(options.top_k, MAX_TRIED), "gripper": robot.gripper_geometry}
    return options.model_copy(update=changes)


def plan_picks(
    detection: Detection,  # made with the options of `options_for_robot`
    scene: Scene | None,  # the detection's; None: too little is left of the cloud
    options: DetectOptions,  # as they were sent
    robot: Robot,
    deadline: float = float("inf"),  # when to stop, on `time.monotonic()`
) -> Detection:
    """Plan the arm's motion to grasps, and put reachable grasps first.

    Returns the detection with `top_k` grasps: those with a trajectory, then others within reach,
    then those not tried in time, then those out of reach; better ones first, and nearer ones first
    at similar scores. InvalidRequest: the arm collides at the joints in the options.
    """
    robot_option = options.robot
    assert robot_option is not None
    if scene is None:
        return detection
    start_joints = np.clip(robot_option.joints, robot.lower, robot.upper).tolist()
    robot_option = robot_option.model_copy(update={"joints": start_joints})
    start = time.perf_counter()
    picks: list[_Pick] = []
    failures: Counter[str] = Counter()
    joints, kept = np.array(start_joints), _kept(detection)
    rank = partial(_rank, joints=joints, options=options, kept=kept)
    with arm_obstacles(robot, scene, robot_option, options.collision.obstacles) as obstacles:
        grasps = [grasp for grasp in detection.grasps if grasp.object not in obstacles.own]
        failures["on_arm"] = len(detection.grasps) - len(grasps)
        arm = _Arm(robot, robot_option, scene, options, obstacles, detection.objects, deadline)
        moves, waiting = robot_option.plan == "motion", iter(grasps)
        missing = options.top_k
        while missing > 0 and time.monotonic() < deadline:
            half = (time.monotonic() + deadline) / 2 if moves else deadline  # the rest for motions
            tried = arm.reach_some(waiting, missing + (EXTRA_GRASPS if moves else 0), half)
            if not tried:
                break
            failures.update(pick.outcome for pick in tried)
            tried.sort(key=rank)
            for pick in tried:
                if moves and missing > 0 and pick.line and time.monotonic() <= deadline:
                    pick = arm.motion(pick)
                picks.append(pick)
                missing -= pick.tier <= (0 if moves else 1)
        untried = [_Pick(grasp, ArmPlan(False), "untried") for grasp in waiting]
    picks = sorted([*picks, *untried], key=rank)[: options.top_k]
    return _reported(detection, picks, failures, robot_option, time.perf_counter() - start)


@dataclass(frozen=True)
class _Pick:
    """A grasp and the arm's plan for it."""

    grasp: Grasp
    plan: ArmPlan
    outcome: str  # the name of a count, or `untried`
    line: Sequence[Float64] = ()  # joints (J,) along the approach; empty: out of reach
    put: "_PutDown | None" = None  # where the object goes, if anywhere

    @property
    def tier(self) -> int:
        """0: with a trajectory, 1: within reach, 2: not tried, 3: out of reach."""
        if self.outcome == "untried":
            return 2
        return 3 if not self.plan.reachable else int(self.plan.trajectory is None)


class _PutDown(NamedTuple):
    """How an object is put down: joints (J,) along straight lines, and what the hand carries."""

    back: Sequence[Float64]  # away from the grasp
    down: Sequence[Float64]  # to the place
    away: Sequence[Float64]  # from the place, the hand empty
    obstacles: ArmObstacles  # without the load
    load: Load


class _Arm:
    """The arm of one request, in its surroundings."""

    def __init__(
        self,
        robot: Robot,
        robot_option: RobotArm,
        scene: Scene,
        options: DetectOptions,
        obstacles: ArmObstacles,
        objects: Sequence[DetectedObject],
        deadline: float,
    ) -> None:
        self._robot, self._scene, self._options, self._obstacles = robot, scene, options, obstacles
        self._place, self._objects = robot_option.place, {one.number: one for one in objects}
        self._deadline, self._path_seconds = deadline, PATH_SECONDS
        self._without_place: set[int] = set()  # numbers of objects
        self._start = np.array(robot_option.joints)
        self._start_x = robot.forward_kinematics(self._start)[:3, 0]
        near = np.maximum(robot.lower, self._start - np.pi)
        far = np.minimum(robot.upper, self._start + np.pi)
        drawn = np.random.default_rng(options.seed).uniform(near, far, (IK_RESTARTS, len(near)))
        self._drawn = list(drawn)  # joints to start from if the given ones find no solution
        self._T_base_cloud = np.reshape(robot_option.T_base_cloud, (4, 4))
        up = scene.frame.directions_to_cloud((0.0, 0.0, 1.0))
        self._up = self._T_base_cloud[:3, :3] @ up
        if self._place is not None and self._place.region is not None and self._up[2] < MIN_LEVEL:
            fix = "Send T_base_object, or the poses of a base frame whose z is up."
            value = f"a region where up is {self._up.round(2).tolist()} in the base frame"
            raise InvalidRequest("options.robot.place.region", value, fix)

    def reach_some(self, grasps: Iterator[Grasp], wanted: int, deadline: float) -> list[_Pick]:
        """The next picks, until `wanted` of them are within reach or time is up."""
        picks: list[_Pick] = []
        while wanted > 0 and time.monotonic() < deadline and (grasp := next(grasps, None)):
            picks.append(self._reach_either_way(grasp))
            wanted -= picks[-1].outcome == "reachable"
        return picks

    def _reach_either_way(self, grasp: Grasp) -> _Pick:
        """Reach a grasp with the hand as given or turned by 180 degrees; the nearer one first."""
        if not grasp.collision_free:
            return _Pick(grasp, ArmPlan(reachable=False), "hand_collision")
        T_base_hand = self._T_base_cloud @ grasp.T_cloud_hand
        length = self._options.collision.approach_length
        poses = _straight(T_base_hand, T_base_hand[:3, 2], -length, 0.0)
        turns = [np.ones_like(HALF_TURN)]
        if self._robot.gripper.symmetric:
            turns.append(HALF_TURN)
            if T_base_hand[:3, 0] @ self._start_x < 0.0:
                turns.reverse()
        robot, failures = self._robot, {"out_of_reach"}
        for turn in turns:
            starts = [self._start, robot.home, *self._drawn]
            line, outcome = self._reach(poses * turn, starts, robot.scene, robot.straight_scene)
            if line:
                hand, tcp = grasp.T_cloud_hand * turn, grasp.T_cloud_tcp * turn
                way = replace(grasp, T_cloud_hand=hand, T_cloud_tcp=tcp)
                pick = _Pick(way, ArmPlan(True, line[0], line[-1]), outcome, line)
                placed = pick if self._place is None else self._with_place(pick, self._place)
                if placed is not None:
                    return placed
                outcome = "no_place"
            failures.add(outcome)
        return _Pick(grasp, ArmPlan(False), max(failures, key=FAILURES.index))

    def _reach(
        self,
        poses: Floats,  # (S, 4, 4) T_base_hand along a straight line
        starts: Sequence[Float64],  # joints (J,) from which the inverse kinematics start
        first: core.Scene,  # in which the start of the line must be collision-free
        along: core.Scene,  # in which the whole line must be collision-free
    ) -> tuple[list[Float64], str]:
        """Joints (J,) at the poses, each near the one before, or none; and the outcome."""
        outcome = "out_of_reach"
        for start in starts:
            line: list[Float64] = []
            for pose in poses:
                joints = self._robot.joints_at(pose, line[-1] if line else start)
                if joints is None or (line and np.abs(joints - line[-1]).max() > MAX_JUMP):
                    break
                line.append(joints)
            else:
                if not (first.hasCollisions(line[0]) or _touches(along, line, PATH_CHECK_STEP)):
                    return line, "reachable"
                outcome = "arm_collision"
        return [], outcome

    def motion(self, pick: _Pick) -> _Pick:
        """Add a collision-checked trajectory, if one is found."""
        free, straight = self._robot.scene, self._robot.straight_scene
        back = self._retreat(pick) if pick.put is None else pick.put.back
        first = self._free_motion(free, self._start, pick.line[0]) if back else None
        if first is None:
            return pick
        timed = [first, *(self._timed(straight, way, True) for way in (pick.line, back))]
        if (put := pick.put) is not None:
            # From the end of the retreat to above the place, down, and back with an empty hand.
            T_base_hand = self._T_base_cloud @ pick.grasp.T_cloud_hand
            with scene_with_load(self._robot, put.obstacles, put.load, T_base_hand) as scene:
                over = self._free_motion(scene, put.back[-1], put.down[0])
                timed += [over, self._timed(scene, put.down, True)]
                scene.removeGeometry(HELD_NAME)
                timed.append(self._timed(scene, put.away, True))
        parts = [part for part in timed if part is not None]
        if len(parts) < len(timed):
            return pick
        times, ends = [0.0], []
        positions, velocities = [self._start], [np.zeros(len(self._start))]
        for part in parts:
            times += [times[-1] + since for since in part.times[1:]]
            positions += part.positions[1:]
            velocities += part.velocities[1:]
            ends.append(len(times) - 1)
        rows = np.array(times), np.array(positions), np.array(velocities)
        release = None if pick.put is None else ends[4]
        trajectory = ArmTrajectory(self._robot.joint_names, *rows, ends[0], ends[1], release)
        return replace(pick, plan=replace(pick.plan, trajectory=trajectory))

    def _with_place(self, pick: _Pick, place: Place) -> _Pick | None:
        """Add how the object is put down, in the first place within reach; None: there is none."""
        grasp, rules = pick.grasp, self._options.collision
        if grasp.object in self._without_place:
            return None
        held = held_points(grasp, self._scene, self._robot.gripper)
        seen = None if grasp.object is None else self._objects.get(grasp.object)
        load = build_load(held, seen, self._scene, self._T_base_cloud)
        back = self._retreat(pick, held)
        if load is None or not back:
            return None
        obstacles = self._obstacles.without(load)
        over = max(rules.approach_length, rules.retreat_length)
        boxes = SolidBoxes.from_shapes(rules.obstacles, CanonicalFrame(self._T_base_cloud))
        free = obstacles.voxels, boxes
        places = places_for(place, load, *free, self._scene, self._T_base_cloud)
        if (first := next(places, None)) is None:
            own = self._scene.object_of_point == grasp.object
            if grasp.object is not None and own.sum() == len(held.points):  # and nothing beside it
                self._without_place.add(grasp.object)
            return None
        T_base_hand = self._T_base_cloud @ grasp.T_cloud_hand
        T_box_hand = np.linalg.inv(load.T_base_box) @ T_base_hand
        with scene_with_load(self._robot, obstacles, load, T_base_hand) as scene:
            for T_base_box in islice(chain([first], places), MAX_PLACES):
                T_base_place = T_base_box @ T_box_hand
                poses = _straight(T_base_place, self._up, over, 0.0)
                down, _ = self._reach(poses, [back[-1], *self._drawn], scene, scene)
                if down:
                    scene.removeGeometry(HELD_NAME)
                    out = _straight(T_base_place, -T_base_place[:3, 2], 0.0, rules.approach_length)
                    away, _ = self._reach(out, down[-1:], scene, scene)
                    hand = self._robot.forward_kinematics(down[-1])
                    plan = replace(pick.plan, place_joints=down[-1], T_base_place=hand)
                    put = _PutDown(back, down, away, obstacles, load)
                    return replace(pick, plan=plan, put=put) if away else None
        return None

    def _retreat(self, pick: _Pick, held: HeldPoints | None = None) -> list[Float64]:
        """Joints along the retreat if the held points touch nothing on it, else an empty list."""
        rules = self._options.collision
        T_base_hand = self._T_base_cloud @ pick.grasp.T_cloud_hand
        back = rules.retreat_length == 0.0 or rules.retreat_direction == "back"
        direction = -T_base_hand[:3, 2] if back else self._up
        # The detector has already checked the hand's approach and retreat.
        length = rules.retreat_length or rules.approach_length
        way = self._T_base_cloud[:3, :3].T @ direction * length
        poses, straight = _straight(T_base_hand, direction, 0.0, length), self._robot.straight_scene
        line, _ = self._reach(poses, pick.line[-1:], straight, straight)
        held = held or held_points(pick.grasp, self._scene, self._robot.gripper)
        return line if line and can_leave(held, self._scene, way, rules) else []

    def _free_motion(
        self, scene: core.Scene, start: Float64, end: Float64
    ) -> core.JointTrajectory | None:
        """A collision-free motion from rest to rest."""
        for step in (PATH_CHECK_STEP, TRAJECTORY_CHECK_STEP):
            path = self._free_path(scene, start, end, step)
            timed = self._timed(scene, path) if path else None
            if timed is not None or not path:
                return timed
        return None

    def _free_path(
        self, scene: core.Scene, start: Float64, end: Float64, step: float
    ) -> list[Float64]:
        """Joints between which linear joint motions are collision-free; empty: none were found."""
        names, seed = self._robot.joint_names, self._options.seed % 2**31
        options = RRTOptions(GROUP, 3000, rrt_connect=True, collision_check_step_size=step)
        begin = time.monotonic()
        # A limit of nodes is not enough: a blocked search adds none. A time of zero means no limit.
        options.max_planning_time = max(1e-3, min(self._path_seconds / 3, self._deadline - begin))
        planner = RRT(scene, options)
        planner.setRngSeed(seed)
        first, last = (core.JointConfiguration(names, joints) for joints in (start, end))
        try:
            path = planner.plan(first, last)
        except RuntimeError:  # no path within these limits
            self._path_seconds -= time.monotonic() - begin
            return []
        rules = core.PathShortcuttingOptions(GROUP, step, seed=seed)
        return list(map(np.array, core.PathShortcutter(scene, rules).shortcut(path).positions))

    def _timed(
        self, scene: core.Scene, joints: Sequence[Float64], straight: bool = False
    ) -> core.JointTrajectory | None:
        """A time-parameterised path from rest to rest, checked along its whole length."""
        path = core.JointPath()
        path.joint_names, path.positions = self._robot.joint_names, list(joints)
        mode = SplineFittingMode.Cubic if straight else SplineFittingMode.Adaptive
        options = TOPPRAOptions(
            dt=STEP_SECONDS, mode=mode, velocity_scale=LIMIT_SHARE, acceleration_scale=LIMIT_SHARE
        )
        try:
            found = PathParameterizerTOPPRA(scene, GROUP).generate(path, options)
        except RuntimeError:
            return None
        rows = np.array(found.positions)
        if not all(map(scene.isValidConfiguration, rows)):
            return None
        if straight:
            poses = map(self._robot.forward_kinematics, (*rows, joints[-1]))
            hand = np.array([T_base_hand[:3, 3] for T_base_hand in poses])
            along = unit(hand[-1] - hand[0])
            if np.linalg.norm(np.cross(hand - hand[0], along), axis=1).max() > MAX_OFF_LINE:
                return None
        return None if _touches(scene, rows, TRAJECTORY_CHECK_STEP) else found


def _touches(scene: core.Scene, joints: Sequence[Float64] | Float64, step: float) -> bool:
    """Whether the robot touches anything at joints (J,) or between them, every `step` radians."""
    return any(map(scene.hasCollisions, joints)) or any(
        core.hasCollisionsAlongPath(scene, *ends, step, check_endpoints=False)
        for ends in pairwise(joints)
    )


def _straight(T_base_hand: Floats, direction: Floats, begin: float, end: float) -> Floats:
    """Poses (S, 4, 4) along a direction of the base frame, `begin` to `end` metres from a hand."""
    steps = max(1, int(np.ceil(abs(end - begin) / LINE_STEP)))
    poses = np.repeat(T_base_hand[None], steps + 1, axis=0)
    poses[:, :3, 3] += np.linspace(begin, end, steps + 1)[:, None] * direction
    return poses


def _kept(detection: Detection) -> int | None:
    """The id of the grasp that is kept from an earlier answer, the first; None: there is none."""
    state = detection.tracking
    return detection.grasps[0].id if state is not None and state.first == Following.KEPT else None


def _rank(
    pick: _Pick, joints: Float64, options: DetectOptions, kept: int | None
) -> tuple[int, float]:
    """Sort key: tier, then the kept grasp, then score and motion unless another order is asked."""
    if kept is not None and pick.grasp.id == kept:
        return pick.tier, -np.inf
    if pick.plan.pregrasp_joints is None or options.order != "score":
        return pick.tier, 0.0
    travel = np.abs(pick.plan.pregrasp_joints - joints).max()
    return pick.tier, TRAVEL_COST * float(travel) - pick.grasp.score


def _reported(
    detection: Detection,
    picks: Sequence[_Pick],
    outcomes: Counter[str],
    asked: RobotArm,
    seconds: float,
) -> Detection:
    """The detection with the picks as its grasps, and counts of their outcomes."""
    tiers = [pick.tier for pick in picks]
    grasps = [replace(pick.grasp, arm=None if pick.tier == 2 else pick.plan) for pick in picks]
    warnings = list(detection.warnings)
    if detection.grasps and not outcomes["reachable"] and 2 not in tiers:
        warnings.append(NO_REACH)
    if asked.plan == "motion" and 1 in tiers:
        why = "no collision-free one was found in time."
        warnings.append(f"{tiers.count(1)} grasps within reach have no trajectory: {why}")
    if 2 in tiers:
        warnings.append("time ran out before the arm was planned for every grasp.")
    names = "on_arm", "hand_collision", "out_of_reach", "arm_collision", "no_place", "reachable"
    counts = {name: n for name, n in detection.counts.items() if name != "returned"}
    counts |= {name: outcomes[name] for name in names if asked.place or name != "no_place"}
    if asked.plan == "motion":
        counts["with_trajectory"] = tiers.count(0)
    counts["returned"] = len(grasps)
    best = {grasp.object: grasp.score for grasp in sorted(grasps, key=lambda one: one.score)}
    total, tracking = detection.seconds.get("total", 0.0) + seconds, detection.tracking
    if tracking is not None and (kept := _kept(detection)) is not None:
        still = bool(grasps) and grasps[0].id == kept and tiers[0] < 3
        tracking = tracking if still else replace(tracking, first=Following.LOST)
    return replace(
        detection,
        tracking=tracking,
        grasps=grasps,
        counts=counts,
        seconds=detection.seconds | {"arm": seconds, "total": total},
        warnings=warnings,
        objects=[replace(one, best_score=best.get(one.number)) for one in detection.objects],
    )
