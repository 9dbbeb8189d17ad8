"""One round of clutter removal: look, plan, grasp, until the table is empty or hope is lost.

The loop knows a planner only as something to call; what runs behind it is the caller's affair.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from edgegrasp_sim.grasping import GraspOutcome
from edgegrasp_sim.simulation import NOISE_STD, Observation

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from edgegrasp_sim.objects import SceneKind
    from edgegrasp_sim.simulation import ClutterSimulation

NUM_OBJECTS = 5
MAX_CONSECUTIVE_FAILURES = 2
# The reference looks again when nothing can be planned, and gives up at the third time.
MAX_NO_GRASP = 3
MIN_POINTS = 100


@dataclass(frozen=True, slots=True)
class PlannedGrasp:
    """A planner's answer.

    Attributes:
        T_world_hand: (4, 4) pose of the `panda_hand` link in the world, metres.
        score: the planner's opinion of the grasp, higher is better.
        width: opening that the grasp needs, metres.
    """

    T_world_hand: ArrayLike
    score: float
    width: float


# From what is seen, and a seed for whatever is random in planning, to the grasp to execute;
# None if there is none.
Planner: TypeAlias = Callable[[Observation, int], PlannedGrasp | None]


class Stream(IntEnum):
    """The random streams of a round; none depends on what another was used for."""

    SCENE = 0
    CAMERA = 1
    NOISE = 2
    POLICY = 3


class RoundEnd(StrEnum):
    """Why a round ended."""

    CLEARED = "cleared"
    FAILURES = "consecutive failures"
    NO_GRASP = "no grasp found"
    NOTHING_SEEN = "too few points seen"


@dataclass(frozen=True, slots=True)
class Attempt:
    """One executed grasp.

    Attributes:
        outcome: what came of it.
        object: name of the object removed, None after a failure.
        score: the planner's score.
        width: the opening the planner asked for, metres.
        opening: metres between the fingers at the end.
        start_contact: whether the open hand overlapped something at its start pose.
        points: size of the cloud that was seen.
        planning_seconds: wall-clock time of the planner.
        T_world_hand: (4, 4) row-major pose of the hand.
    """

    outcome: GraspOutcome
    object: str | None
    score: float
    width: float
    opening: float
    start_contact: bool
    points: int
    planning_seconds: float
    T_world_hand: list[list[float]]


@dataclass(frozen=True, slots=True)
class Round:
    """One round of clutter removal.

    Attributes:
        index: number of the round, which with the seed gives its scene.
        objects: how many objects were there after the reset.
        attempts: the grasps executed, in order.
        no_grasp: how often the planner found no grasp; not counted as attempts, as in the
            reference.
        end: why the round ended.
    """

    index: int
    objects: int
    attempts: tuple[Attempt, ...]
    no_grasp: int
    end: RoundEnd

    @property
    def successes(self) -> int:
        """How many objects were removed by grasping."""
        return sum(attempt.outcome is GraspOutcome.SUCCESS for attempt in self.attempts)


def random_stream(seed: int, round_index: int, stream: Stream) -> np.random.Generator:
    """The generator of one stream of one round."""
    return np.random.default_rng([seed, round_index, stream])


def run_round(
    simulation: ClutterSimulation,
    planner: Planner,
    scene: SceneKind | str,
    *,
    seed: int,
    index: int,
    num_objects: int = NUM_OBJECTS,
    noise_std: float = NOISE_STD,
) -> Round:
    """Run one round; scene and views depend on `seed` and `index` alone.

    Args:
        simulation: is reset first.
        planner: called once for every view.
        scene: `packed` or `pile`.
        seed: not negative.
        index: number of the round, not negative.
        num_objects: how many objects to try to place.
        noise_std: of the points seen, metres.

    Raises:
        ValueError: unknown scene, a negative seed or index, or the planner's pose is no rigid
            transform.
    """
    if seed < 0 or index < 0:
        raise ValueError(f"seed is {seed} and index {index}; pass numbers of 0 or more")
    camera = random_stream(seed, index, Stream.CAMERA)
    noise = random_stream(seed, index, Stream.NOISE)
    policy = random_stream(seed, index, Stream.POLICY)
    objects = simulation.reset(scene, random_stream(seed, index, Stream.SCENE), num_objects)

    attempts: list[Attempt] = []
    failures = no_grasp = 0
    while True:
        if simulation.num_objects == 0:
            end = RoundEnd.CLEARED
            break
        if failures >= MAX_CONSECUTIVE_FAILURES:
            end = RoundEnd.FAILURES
            break
        if no_grasp >= MAX_NO_GRASP:
            end = RoundEnd.NO_GRASP
            break
        observation = simulation.observe(camera, noise, noise_std=noise_std)
        if len(observation.cloud) < MIN_POINTS:
            end = RoundEnd.NOTHING_SEEN
            break
        attempt = _attempt(simulation, planner, observation, int(policy.integers(2**31)))
        if attempt is None:
            no_grasp += 1
            continue
        attempts.append(attempt)
        failures = 0 if attempt.outcome is GraspOutcome.SUCCESS else failures + 1
    return Round(index, objects, tuple(attempts), no_grasp, end)


def _attempt(
    simulation: ClutterSimulation, planner: Planner, observation: Observation, seed: int
) -> Attempt | None:
    started = time.perf_counter()
    grasp = planner(observation, seed)
    seconds = time.perf_counter() - started
    if grasp is None:
        return None
    result = simulation.execute_grasp(grasp.T_world_hand)
    return Attempt(
        outcome=result.outcome,
        object=result.held.model.name if result.held is not None else None,
        score=float(grasp.score),
        width=float(grasp.width),
        opening=result.opening,
        start_contact=result.start_contact,
        points=len(observation.cloud),
        planning_seconds=seconds,
        T_world_hand=np.asarray(grasp.T_world_hand, dtype=np.float64).tolist(),
    )
