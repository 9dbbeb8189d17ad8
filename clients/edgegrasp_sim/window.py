"""PyBullet's window, for a person who watches a round or drives it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import pybullet

from edgegrasp_sim.picture import fork
from edgegrasp_sim.trials import Closes, PlannedGrasp, Planner, TriesGrasps
from edgegrasp_sim.world import TIME_STEP

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from edgegrasp_sim.grasping import GraspResult
    from edgegrasp_sim.observation import Observation
    from edgegrasp_sim.world import World

TARGET = (0.15, 0.15, 0.12)  # metres, what the window's camera looks at
DISTANCE, YAW, PITCH = 0.38, 30.0, -30.0  # metres and degrees
SHOW_SECONDS = 1.0  # that a planned grasp stays to be seen
GRASP_COLOUR = (0.85, 0.0, 0.0)
SPACE = ord(" ")


class Window:
    """The window of a world: near the workspace, no faster than time, and held by the space bar.

    Args:
        world: opened with its window.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.held = False
        self._due = time.perf_counter()
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=world.client)
        pybullet.resetDebugVisualizerCamera(
            DISTANCE, YAW, PITCH, TARGET, physicsClientId=world.client
        )
        world.on_step = self.on_step

    def on_step(self) -> None:
        """Wait until a time step of the world has also passed here, and while it is held."""
        self._due = max(self._due + TIME_STEP, time.perf_counter() - TIME_STEP)
        time.sleep(max(0.0, self._due - time.perf_counter()))
        self._wait_while_held()

    def show(self, grasp: PlannedGrasp) -> None:
        """Draw a grasp and leave it to be seen for a second."""
        pybullet.removeAllUserDebugItems(physicsClientId=self.world.client)
        for start, end in fork(grasp.T_world_hand, grasp.width).tolist():
            pybullet.addUserDebugLine(
                start, end, GRASP_COLOUR, lineWidth=4.0, physicsClientId=self.world.client
            )
        until = time.perf_counter() + SHOW_SECONDS
        while time.perf_counter() < until:
            time.sleep(TIME_STEP)
            self._wait_while_held()

    def _wait_while_held(self) -> None:
        self._read_keys()
        while self.held:
            time.sleep(TIME_STEP)
            self._read_keys()

    def _read_keys(self) -> None:
        keys = pybullet.getKeyboardEvents(physicsClientId=self.world.client)
        if keys.get(SPACE, 0) & pybullet.KEY_WAS_TRIGGERED:
            self.held = not self.held


class ShownPlanner:
    """A planner whose grasps are drawn in a window before they are executed."""

    def __init__(self, planner: Planner, window: Window) -> None:
        self.planner, self.window = planner, window

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The planner's grasp."""
        grasp = self.planner(observation, seed)
        if grasp is not None and np.isfinite(grasp.T_world_hand).all():
            self.window.show(grasp)
        return grasp

    def use_trial(self, try_grasp: Callable[[ArrayLike], GraspResult]) -> None:
        """Hand on what tries grasps, if the planner wants it."""
        if isinstance(self.planner, TriesGrasps):
            self.planner.use_trial(try_grasp)

    def close(self) -> None:
        """Close the planner, if it holds anything."""
        if isinstance(self.planner, Closes):
            self.planner.close()
