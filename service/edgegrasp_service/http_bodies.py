"""Bodies of the HTTP answers: what the OpenAPI document promises, and how they are written."""

import math
from typing import Annotated

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from edgegrasp_model.results import DebugInfo, Detection, Grasp, NoGrasp, Outcome, Scoring
from edgegrasp_service.core import ModelInfo
from edgegrasp_service.errors import ErrorReport

KIND_PREFIX = "urn:edgegrasp:error:"

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class GraspBody(_Body):
    """One grasp: move to T_cloud_hand along approach_direction, then close."""

    score: float = Field(description="probability that the grasp holds")
    T_cloud_hand: Matrix = Field(
        description="row-major; hand frame: z out of the palm, y the closing direction"
    )
    T_cloud_tcp: Matrix = Field(description="row-major; tool centre point, same axes")
    width: float = Field(description="opening to command before closing, metres")
    approach_point: Vector = Field(description="p_a, metres, cloud frame")
    contact_point: Vector = Field(description="p_c, metres, cloud frame")
    approach_direction: Vector = Field(description="unit, the direction the hand moves; its +z")
    collision_free: bool = Field(
        description="whether the open hand meets nothing at the grasp and on its ways"
    )
    clearance: float = Field(
        description="metres from the open hand at the grasp to the nearest thing; 0 or less: within"
    )


class DebugBody(_Body):
    """The processed cloud and every candidate, whatever became of it."""

    points: list[Vector] = Field(description="metres, cloud frame")
    normals: list[Vector] = Field(description="unit")
    approach_index: list[int] = Field(description="p_a of each candidate, rows of points")
    contact_index: list[int] = Field(description="p_c of each candidate, rows of points")
    T_cloud_hand: list[Matrix] = Field(description="of each candidate")
    score: list[float | None] = Field(description="of each candidate; null: not scored")
    outcome: list[Outcome] = Field(description="of each candidate")
    support_plane: Row | None = Field(description="unit normal and offset, metres")


class DetectionBody(_Body):
    """Ranked grasps of one cloud, and how they came about."""

    grasps: list[GraspBody] = Field(description="best first")
    counts: dict[str, int] = Field(description="what passed each stage")
    seconds: dict[str, float] = Field(description="spent in each stage, and their total")
    model: str = Field(description="name of the weights used")
    warnings: list[str]
    debug: DebugBody | None = Field(description="null but where options.debug is set")


class EvaluationBody(_Body):
    """What the network says of one edge or hand pose."""

    grasp: GraspBody | None = Field(description="null where it defines none")
    reason: NoGrasp | None = Field(description="why it defines none")


class ScoringBody(_Body):
    """Evaluations of what the caller gave."""

    evaluations: list[EvaluationBody] = Field(description="in the order of the request")
    counts: dict[str, int] = Field(description="what passed each stage")
    seconds: dict[str, float] = Field(description="spent in each stage, and their total")
    model: str = Field(description="name of the weights used")
    warnings: list[str]


class ModelBody(_Body):
    """Loaded weights."""

    name: str
    architecture: str
    digest: str
    parameters: int
    crop_radius: float = Field(description="metres")
    voxel_size: float = Field(description="metres")
    gripper: str
    default: bool = Field(description="whether a request that names no model gets these")
    hand_description: bool = Field(
        description="whether the network sees the hand-frame description"
    )
    device: str = Field(description='where it computes: "cpu", or a GPU such as "cuda:0"')


class ModelsBody(_Body):
    """The weights a request can name."""

    models: list[ModelBody]


class HealthBody(_Body):
    """State of the server."""

    status: str


class ProblemBody(_Body):
    """An error (RFC 9457)."""

    type: str = Field(description=f"{KIND_PREFIX} and the kind, e.g. invalid-request")
    title: str
    status: int
    detail: str
    field: str = Field(description="request field at fault; empty if none is")
    value: str = Field(description="what was received")
    fix: str = Field(description="what to send instead")
    retry_after: float | None = Field(
        description="seconds until another try is worth it, as in Retry-After; null: unknown"
    )


def detection_body(detection: Detection) -> dict[str, object]:
    """A detection as DetectionBody; every float is a float32 written out exactly."""
    return {
        "grasps": [_grasp_body(grasp) for grasp in detection.grasps],
        "counts": detection.counts,
        "seconds": detection.seconds,
        "model": detection.model,
        "warnings": detection.warnings,
        "debug": None if detection.debug is None else _debug_body(detection.debug),
    }


def scoring_body(scoring: Scoring) -> dict[str, object]:
    """Evaluations as ScoringBody."""
    evaluations = [
        {
            "grasp": None if evaluation.grasp is None else _grasp_body(evaluation.grasp),
            "reason": evaluation.reason,
        }
        for evaluation in scoring.evaluations
    ]
    return vars(scoring) | {"evaluations": evaluations}


def written(body: dict[str, object]) -> bytes:
    """A body as JSON: thousands of numbers, which Python's own encoder takes milliseconds for."""
    return orjson.dumps(body)


def models_body(models: list[ModelInfo]) -> dict[str, object]:
    """Loaded weights as ModelsBody."""
    return {"models": [vars(model) for model in models]}


def problem_body(problem: ErrorReport) -> dict[str, object]:
    """An error as ProblemBody."""
    return {
        "type": KIND_PREFIX + problem.kind,
        "title": problem.kind.replace("-", " ").capitalize(),
        "status": problem.status,
        "detail": problem.detail,
        "field": problem.field,
        "value": problem.value,
        "fix": problem.fix,
        "retry_after": problem.retry_after,
    }


def _grasp_body(grasp: Grasp) -> dict[str, object]:
    return {
        "score": _float32(grasp.score),
        "T_cloud_hand": _floats(grasp.T_cloud_hand),
        "T_cloud_tcp": _floats(grasp.T_cloud_tcp),
        "width": _float32(grasp.width),
        "approach_point": _floats(grasp.approach_point),
        "contact_point": _floats(grasp.contact_point),
        "approach_direction": _floats(grasp.approach_direction),
        "collision_free": bool(grasp.collision_free),
        "clearance": _float32(grasp.clearance),
    }


def _debug_body(debug: DebugInfo) -> dict[str, object]:
    scores = debug.score.tolist()
    plane = debug.support_plane
    return {
        "points": _floats(debug.points),
        "normals": _floats(debug.normals),
        "approach_index": debug.approach_index.tolist(),
        "contact_index": debug.contact_index.tolist(),
        "T_cloud_hand": _floats(debug.T_cloud_hand),
        "score": [None if math.isnan(score) else score for score in scores],
        "outcome": debug.outcome,
        "support_plane": None if plane is None else _floats(plane),
    }


def _float32(value: float) -> float:
    return float(np.float32(value))


def _floats(array: NDArray[np.float32]) -> object:
    return np.asarray(array, dtype=np.float32).tolist()
