"""What a person sees of a round must not change it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pybullet

from edgegrasp_sim import window
from edgegrasp_sim.engine import World
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.results import attempts_digest
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.top_down import plan_top_down
from edgegrasp_sim.trial import PlannedGrasp, run_round
from edgegrasp_sim.window import SPACE, ShownPlanner, Window

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest


def test_a_watched_round_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "SHOW_SECONDS", 0.0)
    monkeypatch.setattr(window, "TIME_STEP", 0.0)
    drawn: list[object] = []
    monkeypatch.setattr(
        pybullet, "addUserDebugLine", lambda *line, **_: drawn.append(line)
    )  # without a window, there is nothing to draw on
    rules = load_protocol("edgegrasp")
    with ClutterSimulation() as simulation:
        plain = run_round(simulation, plan_top_down, SceneKind.PACKED, rules, seed=0, index=0)
        planner = ShownPlanner(plan_top_down, Window(simulation.world))
        watched = run_round(simulation, planner, SceneKind.PACKED, rules, seed=0, index=0)
    assert attempts_digest([plain]) == attempts_digest([watched])
    assert len(drawn) == 4 * len(plain.attempts) > 0


def test_the_space_bar_holds_and_lets_go(monkeypatch: pytest.MonkeyPatch) -> None:
    pressed = {SPACE: pybullet.KEY_WAS_TRIGGERED}
    keys = iter([pressed, {}, {}, pressed, {}])
    with World() as world:
        shown = Window(world)
        monkeypatch.setattr(pybullet, "getKeyboardEvents", lambda **_: next(keys))
        world.step()  # goes on after the second time
        assert not shown.held
        world.step()
    assert next(keys, None) is None


def test_a_shown_planner_passes_on_what_planners_can_do() -> None:
    class Full:
        tried: Callable[..., object] | None = None
        closed = False

        def use_trial(self, try_grasp: Callable[..., object]) -> None:
            self.tried = try_grasp

        def close(self) -> None:
            self.closed = True

        def __call__(self, observation: object, seed: int) -> PlannedGrasp:
            return PlannedGrasp(np.full((4, 4), np.nan), 0.0, 0.0)

    with World() as world:
        full = Full()
        shown = ShownPlanner(full, Window(world))
        shown.use_trial(print)
        assert np.isnan(shown(None, 0).T_world_hand).all()  # told off where it is executed
        shown.close()
        assert (full.tried, full.closed) == (print, True)
        bare = ShownPlanner(lambda *_: None, Window(world))
        bare.use_trial(print)
        bare.close()
        assert bare(None, 0) is None
