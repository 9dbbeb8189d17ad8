"""What a robot's outcomes are worth after a shift of domain: `python -m benchmarks.outcomes`.

The simulator plays a robot whose fingers and camera are not those of training. In each scene the
best grasps of every object are tried, and kept as `POST /v1/outcomes` keeps them. Weights
recalibrated on some of the scenes, as by `edgegrasp train --outcomes`, are judged on the others.

usage: python -m benchmarks.outcomes try --scenes 150 --output outcomes.jsonl
       python -m benchmarks.outcomes table outcomes.jsonl
"""

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks.measuring import RESULTS, write_results

from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import DetectOptions
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_training.evaluation import cross_entropy
from edgegrasp_training.outcomes import Outcomes, fit, read_outcomes

FINGER_FRICTION = 0.2  # of training: 0.75
NOISE_STD = 0.002  # metres, of each coordinate of each point; of training: 0.001
PER_OBJECT = 3  # grasps tried of each object in a scene, the best
MIN_SCORE = 0.8  # below which a robot would not try
SIZES = (25, 50, 100, 200)  # outcomes
DRAWS = 400  # of scenes to learn from, for the intervals


def try_grasps(scenes: int, seed: int, output: Path, friction: float, noise: float) -> None:
    """Append the outcomes of the best grasps of every object in simulated scenes."""
    detector = ModelCatalogue.load().get()
    for number in range(scenes):
        streams = [np.random.default_rng([seed, number, stream]) for stream in range(3)]
        with ClutterSimulation() as simulation:
            simulation.hand = replace(simulation.hand, finger_friction=friction)
            simulation.reset(("packed", "pile")[number % 2], streams[0], num_objects=8)
            seen = simulation.observe(streams[1], streams[2], noise_std=noise, table="auto")
            asked = {"viewpoint": seen.camera_position.tolist(), "seed": number, "top_k": 500}
            found = detector.detect(seen.cloud, DetectOptions.model_validate(asked))
            tried: Counter[int | None] = Counter()
            with output.open("a") as file:
                for grasp in found.grasps:
                    tried[grasp.object] += 1
                    if tried[grasp.object] > PER_OBJECT:
                        continue
                    held = simulation.try_grasp(grasp.T_cloud_hand).success
                    line = {"model": found.model, "digest": detector.metadata.digest}
                    line |= {"score": grasp.score, "held": held, "scene": number}
                    file.write(json.dumps(line) + "\n")


def table(path: Path) -> list[dict[str, object]]:
    """Rows of the table: loss and calibration by the number of outcomes learned from."""
    outcomes, rng = read_outcomes(path), np.random.default_rng(0)
    scene = np.array([json.loads(line)["scene"] for line in path.read_text().splitlines()])
    rows = []
    for size in (0, *SIZES):
        figures = []
        for _ in range(DRAWS):
            # Scenes apart, half of them at least to judge by; those drawn twice count twice.
            order = rng.permutation(np.unique(scene))
            half = len(order) // 2
            learn = np.flatnonzero(np.isin(scene, order[:half]))
            judged = np.concatenate(
                [np.flatnonzero(scene == s) for s in rng.choice(order[half:], len(order) - half)]
            )
            chosen = rng.choice(learn, min(size, len(learn)), replace=False)
            scale, shift = fit(outcomes.of(chosen)) if size else (1.0, 0.0)
            logit = scale * outcomes.logit[judged] + shift
            figures.append(_figures(outcomes.of(judged), logit))
        means = np.nanmean(figures, axis=0)
        low, high = np.nanpercentile(figures, [2.5, 97.5], axis=0)
        names = ("cross_entropy", "predicted_minus_held", "passed", "held_of_passed")
        row: dict[str, object] = {"outcomes": size}
        for name, *values in zip(names, means, low, high, strict=True):
            row[name] = [round(float(value), 3) for value in values]
        rows.append(row)
        print(row)
    print(
        f"{len(scene)} outcomes of {len(np.unique(scene))} scenes, {outcomes.held.mean():.3f} held"
    )
    return rows


def _figures(judged: Outcomes, logit: np.ndarray) -> tuple[float, float, float, float]:
    probability = 1.0 / (1.0 + np.exp(-logit))
    gap = float(probability.mean() - judged.held.mean())
    passed = probability >= MIN_SCORE
    held = float(judged.held[passed].mean()) if passed.any() else float("nan")
    return cross_entropy(logit, judged.held), gap, float(passed.mean()), held


def main() -> None:
    """Run one of the two."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    trying = commands.add_parser("try")
    trying.add_argument("--scenes", type=int, default=150)
    trying.add_argument("--seed", type=int, default=1)
    trying.add_argument("--output", type=Path, required=True)
    trying.add_argument("--friction", type=float, default=FINGER_FRICTION)
    trying.add_argument("--noise", type=float, default=NOISE_STD)
    judging = commands.add_parser("table")
    judging.add_argument("outcomes", type=Path)
    given = parser.parse_args()
    if given.command == "try":
        try_grasps(given.scenes, given.seed, given.output, given.friction, given.noise)
    else:
        write_results(RESULTS, "outcomes", {"rows": table(given.outcomes)})


if __name__ == "__main__":
    main()
