"""The simulator's window, for a person who watches a round or drives it."""

import time

import numpy as np

from edgegrasp_sim.engine import TIME_STEP, World
from edgegrasp_sim.picture import fork
from edgegrasp_sim.trial import PlannedGrasp

TARGET = (0.15, 0.15, 0.12)  # metres, what the window's camera looks at
DISTANCE, YAW, PITCH = 0.38, 30.0, -30.0  # metres and degrees
SHOW_SECONDS = 1.0  # that a planned grasp is shown before it is executed
GRASP_COLOUR = (0.85, 0.0, 0.0)


class Window:
    """The window of a world: in real time at most, and paused by the space bar.

    Args:
        world: opened with its window.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.paused = False
        self._due = time.perf_counter()
        world.aim_window(TARGET, DISTANCE, YAW, PITCH)
        world.on_step = self.on_step

    def on_step(self) -> None:
        """Wait until a time step of the world has also passed here, and while paused."""
        self._due = max(self._due + TIME_STEP, time.perf_counter() - TIME_STEP)
        time.sleep(max(0.0, self._due - time.perf_counter()))
        self._wait_while_paused()

    def show(self, grasp: PlannedGrasp) -> None:
        """Draw a grasp and show it for a second."""
        if not np.isfinite(grasp.T_world_hand).all():
            return  # refused where it is executed
        self.world.draw_lines(fork(grasp.T_world_hand, grasp.width), GRASP_COLOUR)
        until = time.perf_counter() + SHOW_SECONDS
        while time.perf_counter() < until:
            time.sleep(TIME_STEP)
            self._wait_while_paused()

    def _wait_while_paused(self) -> None:
        while True:
            if self.world.space_pressed():
                self.paused = not self.paused
            if not self.paused:
                return
            time.sleep(TIME_STEP)
