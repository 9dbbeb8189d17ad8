"""Objects that are computed: hollow ones, and ones drawn at random."""

from pathlib import Path

import numpy as np

from edgegrasp_sim.made_objects import write_object
from edgegrasp_sim.objects import ObjectModel
from edgegrasp_training.drawn_shapes import NUM_DRAWN, drawn_shape
from edgegrasp_training.hollow_shapes import SHAPES, revolved

HOLLOW_SHARE = 0.25  # the rest is drawn
HOLLOW, DRAWN = tuple(SHAPES), tuple(f"made-drawn-{index:03d}" for index in range(NUM_DRAWN))


def any_made_object(folder: Path, rng: np.random.Generator) -> ObjectModel:
    """One of the made objects, written into a folder; `rng` says which."""
    names = HOLLOW if rng.random() < HOLLOW_SHARE else DRAWN
    return made_object(names[int(rng.integers(len(names)))], folder)


def made_object(name: str, folder: Path) -> ObjectModel:
    """Write a made object into a folder; the engine takes its convex hull.

    Args:
        name: One of HOLLOW or DRAWN.
        folder: Made if need be.
    """
    surface = revolved(SHAPES[name]) if name in SHAPES else drawn_shape(DRAWN.index(name))
    return ObjectModel(name, write_object(name, surface, folder))
