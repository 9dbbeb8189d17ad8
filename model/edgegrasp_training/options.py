"""Options of data generation and training; the command line turns them into flags."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field


class GenerationOptions(BaseModel, extra="forbid"):
    """What to generate."""

    scenes: int = Field(100, ge=1, description="Scenes")
    scene: Literal["packed", "pile", "bin", "bin-full", "bin-deep", "table", "shelf"] | None = (
        Field(None, description="Kind of the scenes; default: packed, pile, bin and table")
    )
    views_per_scene: int = Field(2, ge=1, description="Cameras in each scene")
    grasps_per_view: int = Field(
        100,
        ge=0,
        description="Grasps tried in each view, at least two per object if --weights is given; 0: "
        "none, for training with a teacher",
    )
    seed: int = Field(1, ge=0, description="Seed of every random choice")
    weights: Path | None = Field(
        None, description="Weights that clear most of the scenes; their grasps are tried"
    )
    gripper: str = Field(
        "panda",
        description="Hand that tries grasps: a gripper's name or .toml file; random: one per scene",
    )
    household: float = Field(
        0.0, ge=0.0, le=1.0, description="Share of the scenes with random household objects"
    )
    engine: str | None = Field(
        None, description="pybullet or mujoco; default: the first installed one"
    )


class TrainingOptions(BaseModel, extra="forbid"):
    """How to train; the defaults are the recipe for two processor cores."""

    steps: int = Field(20_000, ge=1, description="Number of training steps")
    views_per_step: int = Field(4, ge=1, description="Views in a step")
    balls_per_view: int = Field(8, ge=1, description="Balls of each view in a step")
    learning_rate: float = Field(1e-3, gt=0, description="Initial learning rate; falls to 0")
    rotations: Literal["any", "none"] = Field(
        "any", description="Random rotations of training balls, for edgegrasp networks"
    )
    keep: float = Field(
        0.0, ge=0.0, le=1.0, description="Share of the weights of --start-from in the result"
    )
    evaluate_every: int = Field(250, ge=1, description="Steps between evaluations")
    seed: int = Field(0, ge=0, description="Seed of weights, split and batches")
    mixed_precision: bool = Field(False, description="Matrix products in bfloat16, for a GPU")
