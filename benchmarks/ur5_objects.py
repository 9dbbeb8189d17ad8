"""Hard and adversarial objects, for `ur5-hard` and `ur5-adversarial` and for piles.

The paper's objects are not available.

    python benchmarks/ur5_objects.py FOLDER
    edgegrasp benchmark --robot ur5 --protocol ur5-hard --objects FOLDER/hard
    edgegrasp benchmark --robot ur5 --protocol ur5-adversarial --objects FOLDER/adversarial
    edgegrasp benchmark --scene pile --objects FOLDER/shapes

Hard: twenty household objects of convex parts. Adversarial: eight meshes (joined bodies, rings,
bottles, plates, pots and bows), made like those of the training data; the benchmark scales them to
the hand and decomposes them. Shapes: forty more of these meshes. No weights were trained on any of
them.
"""

from pathlib import Path

import numpy as np
import typer

from edgegrasp_training.shapes import free_shape, household_objects

SEED, HARD, ADVERSARIAL, SHAPES = 2211, 20, 8, 40


def write(folder: Path) -> None:
    """Write the three sets, which are always the same."""
    household_objects(folder / "hard", HARD, np.random.default_rng(SEED))
    for index in range(ADVERSARIAL + SHAPES):
        meshes = folder / ("adversarial" if index < ADVERSARIAL else "shapes")
        meshes.mkdir(parents=True, exist_ok=True)
        shape = free_shape(np.random.default_rng([SEED, index]), index)
        (meshes / f"shape-{index}.obj").write_text(shape)


if __name__ == "__main__":
    typer.run(write)
