"""Between protobuf messages and the core's requests and answers."""

from typing import Any

import numpy as np

from edgegrasp.v1 import grasp_pb2
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.results import DebugInfo, Detection, Scoring
from edgegrasp_service.core import DetectRequest, ModelInfo, ScoreRequest
from edgegrasp_service.errors import ErrorReport
from edgegrasp_service.given_grasps import GivenGrasps
from edgegrasp_service.grasp_wire import grasp_messages
from edgegrasp_service.option_messages import (
    options_from_message,
    plain_fields,
    refuse_unknown_fields,
)
from edgegrasp_service.sent_arrays import PER_POINT, PackedArray
from edgegrasp_service.sent_cloud import DepthCloud, FileCloud, PackedCloud, RosCloud, SentCloud

ERROR_METADATA = "edgegrasp-error-bin"  # trailing: an ErrorDetail


def request_from_message(message: grasp_pb2.DetectGraspsRequest) -> DetectRequest:
    """Take a request apart.

    Raises:
        InvalidRequest: It has no cloud, or a field this server does not know.
    """
    refuse_unknown_fields(message, "request")
    return DetectRequest(_cloud(message), options_from_message(message.options))


def score_request_from_message(message: grasp_pb2.ScoreGraspsRequest) -> ScoreRequest:
    """Take a request to score apart.

    Raises:
        InvalidRequest: It has no cloud, a pose is none, or a field is not known to this server.
    """
    refuse_unknown_fields(message, "request")
    edges, poses = None, None
    if message.edges:
        edges = np.array([(edge.approach_index, edge.contact_index) for edge in message.edges])
    for row, pose in enumerate(message.hand_poses):
        if len(pose.T_cloud_hand) != 16:
            value = f"{len(pose.T_cloud_hand)} numbers"
            raise InvalidRequest(f"hand_poses.{row}.T_cloud_hand", value, "Send 16, row-major.")
    if message.hand_poses:
        poses = np.array([pose.T_cloud_hand for pose in message.hand_poses]).reshape(-1, 4, 4)
    options = options_from_message(message.options)
    return ScoreRequest(_cloud(message), options, GivenGrasps(edges, poses))


def _cloud(message: Any) -> SentCloud:
    """The cloud of either request; both have it in the same fields."""
    which = message.WhichOneof("cloud")
    beside = {
        name: PackedArray(getattr(message, name)) for name in PER_POINT if message.HasField(name)
    }
    if message.depth_images:
        if which is not None:
            fix = "Send one of points, encoded, point_cloud2 and depth_images."
            raise InvalidRequest("depth_images", f"images beside {which}", fix)
        images = [_depth_image(image, row) for row, image in enumerate(message.depth_images)]
        return SentCloud(DepthCloud(images), beside)
    match which:
        case "points":
            return SentCloud(PackedCloud(message.points), beside)
        case "encoded":
            file = message.encoded
            return SentCloud(FileCloud(file.format, file.data), beside)
        case "point_cloud2":
            return SentCloud(RosCloud(plain_fields(message.point_cloud2)), beside)
        case _:
            fix = "Set `points`, `encoded`, `point_cloud2` or `depth_images`."
            raise InvalidRequest("cloud", "nothing", fix)


def _depth_image(message: grasp_pb2.DepthImage, row: int) -> dict[str, object]:
    fields = plain_fields(message)
    if len(message.T_cloud_camera) != 16:
        value = f"{len(message.T_cloud_camera)} numbers"
        field = f"depth_images.{row}.T_cloud_camera"
        raise InvalidRequest(field, value, "Send 16, row-major.")
    rows = [list(message.T_cloud_camera[start : start + 4]) for start in range(0, 16, 4)]
    return fields | {"T_cloud_camera": rows}


def detection_message(detection: Detection) -> grasp_pb2.DetectGraspsResponse:
    """A detection as a message."""
    return grasp_pb2.DetectGraspsResponse(
        grasps=grasp_messages(detection.grasps),
        counts=detection.counts,
        seconds=detection.seconds,
        model=detection.model,
        warnings=detection.warnings,
        debug=None if detection.debug is None else _debug_message(detection.debug),
    )


def scoring_message(scoring: Scoring) -> grasp_pb2.ScoreGraspsResponse:
    """Evaluations as a message."""
    scored = [each.grasp for each in scoring.evaluations if each.grasp is not None]
    grasps = iter(grasp_messages(scored))
    return grasp_pb2.ScoreGraspsResponse(
        evaluations=[
            grasp_pb2.Evaluation(
                grasp=None if each.grasp is None else next(grasps), reason=each.reason
            )
            for each in scoring.evaluations
        ],
        counts=scoring.counts,
        seconds=scoring.seconds,
        model=scoring.model,
        warnings=scoring.warnings,
    )


def models_message(models: list[ModelInfo]) -> grasp_pb2.ListModelsResponse:
    """Loaded weights as a message."""
    return grasp_pb2.ListModelsResponse(models=_models(models))


def reloaded_message(models: list[ModelInfo]) -> grasp_pb2.ReloadModelsResponse:
    """Weights loaded anew as a message."""
    return grasp_pb2.ReloadModelsResponse(models=_models(models))


def _models(models: list[ModelInfo]) -> list[grasp_pb2.Model]:
    return [grasp_pb2.Model(**vars(model)) for model in models]


def error_message(problem: ErrorReport) -> grasp_pb2.ErrorDetail:
    """An error as the message in the trailing metadata."""
    return grasp_pb2.ErrorDetail(
        kind=problem.kind,
        field=problem.field,
        value=problem.value,
        fix=problem.fix,
        retry_after=problem.retry_after,
    )


def stream_response(
    request_id: str, answer: grasp_pb2.DetectGraspsResponse | ErrorReport
) -> grasp_pb2.DetectGraspsStreamResponse:
    """The answer to one request of a stream."""
    if isinstance(answer, grasp_pb2.DetectGraspsResponse):
        return grasp_pb2.DetectGraspsStreamResponse(request_id=request_id, detection=answer)
    error = grasp_pb2.StreamError(
        code=answer.code.value[0], message=answer.detail, detail=error_message(answer)
    )
    return grasp_pb2.DetectGraspsStreamResponse(request_id=request_id, error=error)


def _debug_message(debug: DebugInfo) -> grasp_pb2.DebugInfo:
    plane = debug.support_plane
    return grasp_pb2.DebugInfo(
        points=np.ravel(debug.points).tolist(),
        normals=np.ravel(debug.normals).tolist(),
        approach_index=debug.approach_index.tolist(),
        contact_index=debug.contact_index.tolist(),
        T_cloud_hand=np.ravel(debug.T_cloud_hand).tolist(),
        score=debug.score.tolist(),
        outcome=debug.outcome,
        support_plane=[] if plane is None else plane.tolist(),
    )
