"""The training loop: resumes at the exact step and keeps the best network."""

import csv
import math
import time
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.networks.edgegrasp import EdgeGraspNet
from edgegrasp_model.networks.hand import HandNet
from edgegrasp_training import examples, recipes
from edgegrasp_training.evaluation import ScoreMetrics, evaluate_scores, write_model_card
from edgegrasp_training.options import TrainingOptions
from edgegrasp_training.views import load_view

VIEWS_IN_MEMORY = 8000
WEIGHT_DECAY = 1e-4
AVERAGING = 0.998  # share of the running mean of the weights kept at each step
UNKNOWN = 0.1  # share of training views without a known support, and without a known camera
DROPOUT_STREAM = 1  # random stream of a step
STATE_FILE, LOG_FILE = "state.pt", "log.csv"
# Attributes of a trainer that its state file keeps.
COUNTERS = ("step", "best_loss", "seconds")
STATEFUL = ("network", "average", "optimizer")


class Trainer:
    """Trains one network; its run folder contains everything needed to resume."""

    def __init__(
        self,
        metadata: CheckpointMetadata,  # name, widths and gripper of the network to train
        train_paths: list[Path],  # view files
        validation_paths: list[Path],  # view files of other scenes
        folder: Path,  # for `state.pt`, `log.csv` and `NAME.safetensors`, the best so far
        options: TrainingOptions,  # the recipe
        device: torch.device | str = "cpu",  # of the network
        teacher: examples.Teacher | None = None,  # scores further candidates to learn from
        start: Path | None = None,  # weights to start from; None: random weights
    ) -> None:
        """Set up, or resume from the folder's last state; ValueError if the options do not fit."""
        if teacher is not None and metadata.network.architecture == "hand":
            raise ValueError(f"teacher: {metadata.name} learns from labels alone. Name none.")
        self.teacher = teacher
        self.metadata, self.folder, self.options, self.device = metadata, folder, options, device
        self.train_paths, self.validation_paths = train_paths, validation_paths

        def read(path: Path, viewpoint_known: bool) -> examples.TriedGrasps:
            return examples.tried_grasps(load_view(path), metadata.network, viewpoint_known)

        self._tried = lru_cache(maxsize=VIEWS_IN_MEMORY)(read)
        if teacher is not None:
            self._soft_labels = lru_cache(maxsize=VIEWS_IN_MEMORY)(teacher.soft_labels)
        generator = torch.Generator().manual_seed(options.seed)
        self.network = recipes.build_network(metadata.network, generator).to(device)
        self.start = None if start is None else load_checkpoint(start)
        if self.start is not None:
            recipes.start_from(self.network, self.start[0])
        self.average = deepcopy(self.network).requires_grad_(False).eval()
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), options.learning_rate, weight_decay=WEIGHT_DECAY
        )
        self.step, self.best_loss = 0, float("inf")
        self.seconds = 0.0  # spent in training steps
        # Everything that determines the training steps.
        self.recipe = options.model_dump(include={*TrainingOptions.model_fields}) | {
            "data": [path.name for path in train_paths],
            "teacher": teacher and teacher.metadata.digest,
            "start_from": self.start and self.start[1].digest,
        }
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / STATE_FILE).is_file():
            self._resume(folder / STATE_FILE)
        elif self.start is None and isinstance(self.network, HandNet):
            self._standardise(self.network)

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.step >= self.options.steps

    def run(self, until: int | None = None) -> Iterator[tuple[int, float]]:
        """Train until finished, or up to a step; yields each step's number and loss."""
        while not self.finished and (until is None or self.step < until):
            start = time.perf_counter()
            loss = self._train_step()
            self.seconds += time.perf_counter() - start
            self.step += 1
            yield self.step, loss
            if self.step % self.options.evaluate_every == 0 or self.step == self.options.steps:
                evaluation = self.evaluate(balls_per_view=8)
                if evaluation.loss < self.best_loss:
                    self.best_loss = evaluation.loss
                    self._save_average(self.metadata)
                self._log(evaluation, loss)
                self._save_state()
        self._save_state()

    def evaluate(self, balls_per_view: int | None = None) -> ScoreMetrics:
        """Score the validation views, or at most `balls_per_view` balls of each.

        Targets are the outcomes of tried grasps, and with a teacher also its scores.
        """
        logits, labels = [], []
        with torch.inference_mode():
            for number, path in enumerate(self.validation_paths):
                rng = np.random.default_rng([self.options.seed, number])
                packed = self._packed(path, self._tried(path, True), balls_per_view, rng)
                if packed is None:
                    continue
                logits.append(self.average(packed.batch.to(self.device)).float().cpu())
                label = packed.label
                labels.append((label > 0.5).float() if self.teacher is None else label)
        return evaluate_scores(torch.cat(logits).numpy(), torch.cat(labels).numpy())

    def finish(self, provenance: dict[str, Any], command: str) -> ScoreMetrics:
        """Calibrate the best network on all validation views; write it and its card."""
        path = self.folder / f"{self.metadata.name}.safetensors"
        best, saved = load_checkpoint(path)
        recipes.start_from(self.average, best)
        # Mix once with the starting weights (Wortsman et al., CVPR 2022).
        if self.start is not None and not saved.training:
            first = deepcopy(self.average)
            recipes.start_from(first, self.start[0])
            with torch.no_grad():
                for new, old in zip(self.average.parameters(), first.parameters(), strict=True):
                    new.lerp_(old, self.options.keep)
        evaluation = self.evaluate()
        training = provenance | {
            "training_views": len(self.train_paths),
            "training_labels": sum(len(self._tried(p, True).label) for p in self.train_paths),
            "training_hands": len({load_view(path).gripper for path in self.train_paths}),
            "validation_views": len(self.validation_paths),
            "validation_labels": len(evaluation.label),
            "steps": self.step,
            "training_seconds": round(self.seconds),
            "seed": self.options.seed,
        }
        if self.teacher is not None:
            taught = self.teacher.metadata
            training |= {"teacher": taught.name, "teacher_digest": taught.digest}
        if self.start is not None:
            _, started = self.start
            training |= {"started_from": started.name, "started_from_digest": started.digest}
            training |= {"kept_of_it": self.options.keep}
        metadata = replace(self.metadata, temperature=evaluation.temperature, training=training)
        self._save_average(metadata)
        write_model_card(path.with_suffix(".md"), metadata, evaluation, command)
        return evaluation

    def _train_step(self) -> float:
        packed = self._training_batch(np.random.default_rng([self.options.seed, self.step]))
        kind, mixed = torch.device(self.device).type, self.options.mixed_precision
        with torch.autocast(kind, torch.bfloat16, enabled=mixed):
            batch = packed.batch.to(self.device)
            if isinstance(self.network, HandNet):
                draws = np.random.SeedSequence([self.options.seed, self.step, DROPOUT_STREAM])
                left_out = torch.Generator().manual_seed(int(draws.generate_state(1)[0]))
                logit = self.network(batch, left_out).float()
            else:
                logit = self.network(batch).float()
        label, weight = packed.label.to(self.device), packed.weight.to(self.device)
        loss = F.binary_cross_entropy_with_logits(logit, label, weight, reduction="sum")
        loss = loss / weight.sum()
        left = (1.0 + math.cos(math.pi * self.step / self.options.steps)) / 2
        for group in self.optimizer.param_groups:
            group["lr"] = left * self.options.learning_rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        # At first the mean covers only few steps, so that it forgets the random weights.
        kept = min(AVERAGING, (self.step + 1) / (self.step + 10))
        for mean, value in zip(self.average.parameters(), self.network.parameters(), strict=True):
            mean.lerp_(value.detach(), 1.0 - kept)
        return float(loss.detach())

    def _training_batch(self, rng: np.random.Generator) -> examples.Batch:
        """Random balls of random views, determined only by the seed and the step number."""
        count = min(self.options.views_per_step, len(self.train_paths))
        parts: list[examples.Batch] = []
        for index in rng.choice(len(self.train_paths), count, replace=False):
            camera_known, support_known = (rng.random(2) >= UNKNOWN).tolist()
            camera_matters = self.metadata.network.architecture == "hand"
            path = self.train_paths[index]
            grasps = self._tried(path, camera_known or not camera_matters)
            if not support_known:
                grasps = grasps.without_support()
            packed = self._packed(path, grasps, self.options.balls_per_view, rng, vary=True)
            if packed is None:
                continue
            # The paper's network, unlike Vector Neurons, is not equivariant. Without a camera the
            # detector's frame is upright, but its yaw is arbitrary.
            upright = self.options.rotations == "none"
            if isinstance(self.network, EdgeGraspNet) and not (upright and camera_known):
                assert isinstance(packed.batch, BallBatch)
                turn = examples.random_turn(rng, upright=upright)
                packed = packed._replace(batch=examples.turned(packed.batch, turn))
            parts.append(packed)
        if not parts:
            raise ValueError("data: no grasp was tried in the views of this step. Make others")
        batches, labels, weights = zip(*parts, strict=True)
        return examples.Batch(examples.joined(batches), torch.cat(labels), torch.cat(weights))

    def _packed(
        self,
        path: Path,  # of the view
        grasps: examples.TriedGrasps,
        count: int | None,  # maximum number of balls; None: all
        rng: np.random.Generator,  # chooses balls
        *,
        vary: bool = False,  # also choose the points of hands at random
    ) -> examples.Batch | None:
        """Balls of a view with tried grasps or the teacher's scores; None if there are none."""
        network, balls, taught = self.metadata.network, grasps.balls(), None
        if self.teacher is not None:
            taught = self._soft_labels(path)
            balls = np.union1d(balls, taught.candidates.approach_index).astype(np.int64)
        balls = np.sort(rng.choice(balls, min(count or len(balls), len(balls)), replace=False))
        if network.architecture == "hand":
            packed = examples.pack_hands(grasps, balls, network, rng if vary else None)
        else:
            packed = examples.pack_balls(grasps, balls, network, taught)
        return packed if len(packed.label) else None

    def _standardise(self, network: HandNet) -> None:
        """Fit mean and standard deviation of hand descriptions to the training views."""
        seen = [self._tried(path, True).hand_batch for path in self.train_paths]
        values = np.concatenate([hands.description.numpy() for hands in seen if hands is not None])
        mean, std = values.mean(axis=0, dtype=np.float64), values.std(axis=0, dtype=np.float64)
        recipes.set_statistics(network, torch.from_numpy(mean), torch.from_numpy(std))
        self.average.load_state_dict(network.state_dict())

    def _save_average(self, metadata: CheckpointMetadata) -> None:
        """Write the running mean of the weights, for lengths in metres."""
        path = self.folder / f"{metadata.name}.safetensors"
        save_checkpoint(path, recipes.rescaled(self.average, 1.0 / recipes.LENGTH_UNIT), metadata)

    def _log(self, evaluation: ScoreMetrics, train_loss: float) -> None:
        row = {
            "step": self.step,
            "learning_rate": float(f"{self.optimizer.param_groups[0]['lr']:.4g}"),
            "train_loss": round(train_loss, 5),
            "validation_loss": round(evaluation.loss, 5),
            "accuracy": round(evaluation.accuracy, 5),
            "auroc": round(evaluation.auroc, 5),
        }
        with (self.folder / LOG_FILE).open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)

    def _resume(self, file: Path) -> None:
        """Continue from a saved state; ValueError if damaged, or of another model or recipe."""
        try:
            state = torch.load(file, weights_only=True, map_location=self.device)
        except (EOFError, RuntimeError, UnpicklingError) as error:
            raise ValueError(f"run: {file} is damaged: {error}. Remove it") from None
        try:
            for name in STATEFUL:
                getattr(self, name).load_state_dict(state[name])
        except RuntimeError:
            raise ValueError(f"run: {self.folder} holds another model. Name another") from None
        begun = state.get("recipe", self.recipe)
        if changed := [name for name in begun if begun[name] != self.recipe[name]]:
            raise ValueError(
                f"run: {self.folder} was begun with another {', '.join(changed)}. Repeat that "
                "command, or name another folder"
            )
        for name in COUNTERS:
            setattr(self, name, state[name])

    def _save_state(self) -> None:
        state = {name: getattr(self, name) for name in (*COUNTERS, "recipe")}
        state |= {name: getattr(self, name).state_dict() for name in STATEFUL}
        partial = self.folder / (STATE_FILE + ".partial")
        torch.save(state, saved := BytesIO())
        partial.write_bytes(saved.getvalue())
        partial.replace(self.folder / STATE_FILE)
