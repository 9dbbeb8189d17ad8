"""A moving picture of a round, rendered without a display."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pybullet

from edgegrasp_sim.camera import look_at
from edgegrasp_sim.replay import recorded_grasp

if TYPE_CHECKING:
    from pathlib import Path

    from edgegrasp_sim.replay import Replay
    from edgegrasp_sim.trials import Round
    from edgegrasp_sim.world import World

WIDTH, HEIGHT = 480, 360
FIELD_OF_VIEW = 34.0  # degrees
EYE, TARGET = np.array([0.15, -0.47, 0.50]), np.array([0.15, 0.15, 0.12])
STEPS_PER_FRAME = 8  # at 80 steps a second
FRAME_MILLISECONDS = 80
STILL_FRAMES = 8  # that the outcome stays to be read
MAX_ATTEMPTS = 10  # a longer round is cut
COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#e45756", "#b279a2", "#eeca3b", "#72b7b2", "#9d755d")


class Film:
    """Frames of a world as time passes in it, each with a caption."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.caption = ""
        self.frames: list[Any] = []
        self._steps = 0

    def on_step(self) -> None:
        """Take a frame every few steps."""
        self._steps += 1
        if self._steps % STEPS_PER_FRAME == 0:
            self.take()

    def take(self, copies: int = 1) -> None:
        """Take a frame now."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(render(self.world))
        ImageDraw.Draw(image).text((10, 8), self.caption, fill=(20, 20, 20), font_size=18)
        self.frames += [image.quantize(64)] * copies

    def save(self, path: Path) -> None:
        """Write a GIF that runs in a loop."""
        first, *rest = self.frames
        first.save(path, save_all=True, append_images=rest, duration=FRAME_MILLISECONDS, loop=0)


def film_round(replay: Replay, done: Round, path: Path) -> None:
    """Write a GIF of a recorded round.

    Args:
        replay: that `done` is from.
        done: a round with at least one attempt.
        path: file to write.
    """
    driver = replay.start(done)
    for number, body in enumerate(replay.simulation.object_bodies):
        body.paint(COLOURS[number % len(COLOURS)])
    film = Film(replay.simulation.world)
    film.caption = f"round {done.index}, seed {done.seed}: {len(done.objects)} objects"
    film.take(STILL_FRAMES)
    for number, attempt in enumerate(done.attempts[:MAX_ATTEMPTS]):
        replay.advance(driver, done, number, executed=number)
        film.caption = f"grasp {number + 1}"
        film.world.on_step = film.on_step
        driver.execute(recorded_grasp(attempt))
        film.world.on_step = None
        outcome = f"{attempt.object} removed" if attempt.success else str(attempt.cause)
        film.caption = f"grasp {number + 1}: {outcome}"
        film.take(STILL_FRAMES)
    film.save(path)


def render(world: World) -> Any:
    """What a bystander sees: (HEIGHT, WIDTH, 3) uint8."""
    view = np.linalg.inv(look_at(EYE, TARGET))
    view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
    _, _, rgb, _, _ = pybullet.getCameraImage(
        WIDTH,
        HEIGHT,
        viewMatrix=view.flatten(order="F").tolist(),
        projectionMatrix=pybullet.computeProjectionMatrixFOV(
            FIELD_OF_VIEW, WIDTH / HEIGHT, 0.05, 3.0
        ),
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    return np.asarray(rgb, dtype=np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
