"""Objects for the protocols `ur5-hard` and `ur5-adversarial`, since the paper's cannot be had.

    python benchmarks/ur5_objects.py FOLDER
    edgegrasp benchmark --robot ur5 --protocol ur5-hard --objects FOLDER/hard
    edgegrasp benchmark --robot ur5 --protocol ur5-adversarial --objects FOLDER/adversarial

Hard: twenty household objects, each convex part its own contact. Adversarial: meshes of eight
kinds (bodies stuck together, rings, spindles, stars, pots, bows), made as those of the training
data; which the benchmark scales to the hand and decomposes. No weights were trained on these.
"""

import sys
from pathlib import Path

import numpy as np

from edgegrasp_training.shapes import free_shape, household_objects

SEED, HARD, ADVERSARIAL = 2211, 20, 8


def write(folder: Path) -> None:
    """Write both sets, always the same."""
    household_objects(folder / "hard", HARD, np.random.default_rng(SEED))
    meshes = folder / "adversarial"
    meshes.mkdir(parents=True)
    for index in range(ADVERSARIAL):
        shape = free_shape(np.random.default_rng([SEED, index]), index)
        (meshes / f"shape-{index}.obj").write_text(shape)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
