"""Python client of the grasp-detection service, over gRPC or REST.

from edgegrasp_client import GraspClient

with GraspClient("127.0.0.1:50051") as client:  # or "http://127.0.0.1:8000"
detection = client.detect(points, seed=7, top_k=5)
best = detection.grasps[0]
"""

from edgegrasp_client.async_client import AsyncGraspClient
from edgegrasp_client.client import GraspClient
from edgegrasp_client.errors import (
    DeadlineError,
    GraspClientError,
    InvalidRequestError,
    PayloadTooLargeError,
    ProtocolError,
    ServerFailedError,
    ServerUnavailableError,
    UnknownModelError,
)
from edgegrasp_client.options import DetectOptions, SupportPlane, Suppression, Workspace
from edgegrasp_client.results import Detection, Grasp, Model

__all__ = [
    "AsyncGraspClient",
    "DeadlineError",
    "DetectOptions",
    "Detection",
    "Grasp",
    "GraspClient",
    "GraspClientError",
    "InvalidRequestError",
    "Model",
    "PayloadTooLargeError",
    "ProtocolError",
    "ServerFailedError",
    "ServerUnavailableError",
    "SupportPlane",
    "Suppression",
    "UnknownModelError",
    "Workspace",
]
