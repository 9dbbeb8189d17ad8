"""Compare the engines: the same grasps in the same scenes, and where their outcomes differ.

python -m edgegrasp_training.agreement --objects ../shared/objects
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edgegrasp_sim.engine import ENGINES
from edgegrasp_sim.objects import CLUTTER, ObjectSet
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_training.generation import VIEWS, GenerationOptions, ask, choose_grasps
from edgegrasp_training.views import table

HELD = "held"


class Pair(NamedTuple):
    """The outcomes of one grasp in each engine, in the order of `ENGINES`."""

    made_in: str  # the engine that the scene came to rest in
    outcomes: tuple[str, str]  # HELD, or why it failed
    starts_clear: bool  # of contact, in both


def compare_engines(objects: Path | None, options: GenerationOptions) -> Iterator[Pair]:
    """Make packed scenes and piles in either engine in turn, and try grasps in both.

    Objects and grasps are chosen as for generated data.

    Raises:
        RuntimeError: An engine is not installed.
    """
    sets = {
        kind: ObjectSet.builtin(kind)
        if objects is None
        else ObjectSet.from_folder(objects, kind, "train")
        for kind in CLUTTER
    }
    first, second = (ClutterSimulation(sets, engine=engine) for engine in ENGINES)
    with first, second:
        for index in range(options.scenes):
            streams = [np.random.default_rng([options.seed, index, k]) for k in range(5)]
            kind = CLUTTER[index % 2]
            made, copy = (first, second) if index // 2 % 2 == 0 else (second, first)
            made.reset(kind, streams[0], 5)
            copy.reset_from_poses(made.placements)
            for _ in range(options.views_per_scene):
                query = ask(made, kind, VIEWS[kind], streams)
                chosen = choose_grasps(query, options, streams[3], hard=True)
                for pose in () if chosen is None else chosen.T_world_hand:
                    tries = [each.try_grasp(pose, to_the_end=True) for each in (first, second)]
                    one, other = (HELD if t.cause is None else t.cause.value for t in tries)
                    clear = not any(t.start_contact for t in tries)
                    yield Pair(made.world.name, (one, other), clear)


def agreement_table(pairs: list[Pair]) -> str:
    """Markdown: for each outcome in the first engine how often it was which in the second."""
    counts = Counter(pair.outcomes for pair in pairs)
    kinds = sorted({kind for outcomes in counts for kind in outcomes}, key=lambda k: (k != HELD, k))
    head = (f"{ENGINES[0]} \\ {ENGINES[1]}", *kinds)
    rows = [(kind, *(counts[kind, other] or "" for other in kinds)) for kind in kinds]
    lines = table(head, rows)
    groups = {"all": pairs, "the open hand starts clear": [p for p in pairs if p.starts_clear]}
    groups |= {f"scene made in {e}": [p for p in pairs if p.made_in == e] for e in ENGINES}
    facts = []
    for name, group in groups.items():
        held = np.array([[kind == HELD for kind in pair.outcomes] for pair in group]).reshape(-1, 2)
        facts.append((name, len(group), *map(_percent, (*held.T, held[:, 0] == held[:, 1]))))
    lines += ["", *table(("grasps", "number", *(f"{e} held %" for e in ENGINES), "agree %"), facts)]
    return "\n".join(lines)


def _percent(rows: NDArray[np.bool_]) -> str:
    return f"{100 * rows.mean():.1f}" if len(rows) else "-"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m edgegrasp_training.agreement")
    parser.add_argument("--objects", type=Path, help="folder packed/train, pile/train")
    parser.add_argument("--weights", type=Path, help="network that chooses half of the grasps")
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    options = GenerationOptions(given.scenes, 1, 50, given.seed, given.weights)
    pairs = list(compare_engines(given.objects, options))
    sys.stdout.write(agreement_table(pairs) + "\n")


if __name__ == "__main__":
    main()
