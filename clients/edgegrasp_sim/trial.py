"""One round of clutter removal: observe, plan, grasp, until the table is empty or planning fails.

A planner is any callable, which the caller provides.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_results import ArmTrajectory
from edgegrasp_sim.camera import Observation, crop
from edgegrasp_sim.fixed_parts import open_table
from edgegrasp_sim.hand import FailureCause, motion_seconds
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import Protocol
from edgegrasp_sim.simulation import ClutterSimulation

MIN_SEEN = 100  # points above the table; with fewer the planner is not called
SEEN_DISTANCE = 0.01  # metres; a touched surface this near to a seen point counts as seen


@dataclass(frozen=True, slots=True)
class PlannedGrasp:
    """A grasp chosen by a planner."""

    T_world_hand: ArrayLike  # (4, 4) pose of the `panda_hand` link in the world, metres
    score: float  # how good the planner believes the grasp is; higher is better
    width: float  # opening that the grasp needs, metres
    motion: ArmTrajectory | None = None  # of the arm that carries the hand, if any


# Maps an observation, and a seed for randomness in planning, to the grasp to execute, or None. A
# planner may have a method `close`, which is called after the last round.
Planner: TypeAlias = Callable[[Observation, int], PlannedGrasp | None]


class StartCollides(Exception):  # noqa: N818
    """Raised by a planner: according to this view the arm collides before it moves."""


class RoundEnd(StrEnum):
    """Why a round ended."""

    CLEARED = "cleared"
    FAILURES = "consecutive failures"
    NO_GRASP = "no grasp found"


@dataclass(frozen=True, slots=True)
class Attempt:
    """One executed grasp."""

    cause: FailureCause | None  # why it failed, None if it did not
    object: str | None  # name of the object removed, None after a failure
    target: str | None  # name of the object between the fingers before closing, None without one
    wrong_object: bool  # whether the removed object was not the target
    score: float  # the planner's score
    width: float  # the opening that the planner requested, metres
    opening: float  # metres between the fingers at the end
    start_contact: bool  # whether the open hand overlapped something at its start pose
    view: int  # number of the view in its round that the grasp was planned in
    points: int  # number of points in the observed cloud
    planning_seconds: float  # wall-clock time of the planner
    T_world_hand: list[list[float]]  # (4, 4) row-major pose of the hand
    motion_seconds: float = 0.0  # of an arm from home to the grasp, away and home again
    touched_on_the_way: bool = False  # whether an arm overlapped anything before its pregrasp
    touched_seen: bool = False  # whether the camera had seen the surface that was touched

    @property
    def success(self) -> bool:
        """Whether an object was removed."""
        return self.cause is None

    @property
    def T_cloud_hand(self) -> NDArray[np.float32]:  # noqa: N802
        """The pose (4, 4) for `Picture.grasps`; the cloud frame is the world frame."""
        return np.asarray(self.T_world_hand, np.float32)


@dataclass(slots=True)
class Round:
    """One round of clutter removal, updated while it runs."""

    seed: int  # determines, with `index`, the scene, the views and the noise
    index: int  # number of the round
    objects: tuple[str, ...]  # names of the objects after the reset
    attempts: tuple[Attempt, ...]  # the grasps executed, in order
    no_grasp: int  # how often the planner found no grasp; not counted as attempts
    end: RoundEnd  # why the round ended
    too_wide: tuple[str, ...] = ()  # names of objects wider than the hand opens
    start_collisions: int = 0  # number of views without a grasp because the arm collided at start

    @property
    def successes(self) -> int:
        """How many objects were removed by grasping."""
        return sum(attempt.success for attempt in self.attempts)


class RoundDriver:
    """A round: `run` it with a planner, or `look` and `execute` in turn to repeat one."""

    def __init__(
        self,
        simulation: ClutterSimulation,
        scene: SceneKind,
        protocol: Protocol,
        *,
        seed: int,
        index: int,
    ) -> None:
        self.simulation, self.protocol = simulation, protocol
        # Independent streams: the draws from one do not affect the others.
        streams = (np.random.default_rng([seed, index, stream]) for stream in range(4))
        layout, self._camera, self._noise, self._policy = streams
        rules, upright = protocol.scene, scene.objects is SceneKind.PACKED
        simulation.reset(
            scene,
            layout,
            rules.num_objects[index % len(rules.num_objects)],
            rules.packed_scale if upright else rules.pile_scale,
            open_table(rules.table_thickness),
        )
        self.view, self._cloud = -1, np.empty((0, 3), np.float32)
        names = tuple(model.name for model in simulation.object_models)
        wide = tuple(model.name for model in simulation.too_wide)
        self._round = Round(seed, index, names, (), 0, RoundEnd.CLEARED, too_wide=wide)

    @property
    def end(self) -> RoundEnd | None:
        """Why the round has ended, None if it goes on."""
        rules = self.protocol.round
        if self.simulation.num_objects == 0:
            return RoundEnd.CLEARED
        last = self._round.attempts[-rules.max_consecutive_failures :]
        if len(last) == rules.max_consecutive_failures and not any(one.success for one in last):
            return RoundEnd.FAILURES
        return RoundEnd.NO_GRASP if self._round.no_grasp >= rules.max_no_grasp else None

    def run(self, planner: Planner) -> Round:
        """Run the round to its end."""
        while (end := self.end) is None:
            seen, seed = self.observe(), int(self._policy.integers(2**31))
            # An obstacle in front may hide all of the objects.
            height = crop(seen.cloud, seen.workspace)[:, 2] - seen.table_height
            shown = np.count_nonzero(height > 0.005) >= MIN_SEEN
            grasp, started = None, time.perf_counter()
            try:
                grasp = planner(seen, seed) if shown else None
            except StartCollides:
                self._round.start_collisions += 1
            if grasp is None:
                self._round.no_grasp += 1
            else:
                self.execute(grasp, time.perf_counter() - started)
        self._round.end = end
        return self._round

    def observe(self) -> Observation:
        """Take the next view."""
        rules = self.protocol
        seen = self.simulation.observe_from(
            rules.camera.sample(self._camera, rules.camera.views),
            self._noise,
            noise_std=rules.noise.point_std,
            faults=rules.noise.faults(self._noise),
            table=rules.planning.table,
        )
        self.view, self._cloud = self.view + 1, seen.cloud
        return seen

    def execute(self, grasp: PlannedGrasp, planning_seconds: float = 0.0) -> Attempt:
        """Execute a grasp planned in the last view; raises ValueError unless its pose is rigid."""
        if not isinstance(grasp, PlannedGrasp):
            raise ValueError(f"the planner returned {type(grasp)}; return a PlannedGrasp or None")
        result = self.simulation.execute_grasp(grasp.T_world_hand, grasp.motion)
        attempt = Attempt(
            cause=result.cause,
            object=result.held.model.name if result.held is not None else None,
            target=result.target.model.name if result.target is not None else None,
            wrong_object=result.success and result.target not in (None, result.held),
            score=float(grasp.score),
            width=float(grasp.width),
            opening=result.opening,
            start_contact=result.start_contact,
            view=self.view,
            points=len(self._cloud),
            planning_seconds=planning_seconds,
            T_world_hand=np.asarray(grasp.T_world_hand, dtype=np.float64).tolist(),
            motion_seconds=0.0 if grasp.motion is None else motion_seconds(grasp.motion),
            touched_on_the_way=bool(result.touched_on_the_way),
            touched_seen=any(map(self._is_seen, result.touched_on_the_way)),
        )
        self._round.attempts += (attempt,)
        return attempt

    def _is_seen(self, place: Sequence[float]) -> bool:
        distance = np.linalg.norm(np.subtract(self._cloud, place), axis=1)
        return bool((distance <= SEEN_DISTANCE).any())
