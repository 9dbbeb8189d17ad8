"""Python client of the grasp-detection service, over gRPC or REST.

from edgegrasp_client import GraspClient

with GraspClient("127.0.0.1:50051") as client:  # or "http://127.0.0.1:8000"
    detection = client.detect(points, seed=7, top_k=5)
best = detection.grasps[0]
"""

from edgegrasp_client.async_client import AsyncGraspClient
from edgegrasp_client.client import GraspClient
from edgegrasp_client.clouds import DepthImage, Intrinsics, PointCloud2, PointField
from edgegrasp_client.connection import Tls
from edgegrasp_client.errors import (
    AccessDeniedError,
    DeadlineError,
    GraspClientError,
    InvalidRequestError,
    OverloadedError,
    PayloadTooLargeError,
    ProtocolError,
    ServerFailedError,
    ServerUnavailableError,
    UnknownModelError,
)
from edgegrasp_client.options import (
    ApproachDirection,
    Box,
    Collision,
    Cone,
    DetectOptions,
    GripperGeometry,
    HalfSpace,
    HandPart,
    Indices,
    Linkage,
    Mask,
    OrientedBox,
    RansacPlane,
    Region,
    Segments,
    Sphere,
    SupportPlane,
    Suppression,
    Workspace,
)
from edgegrasp_client.requests import StreamRequest
from edgegrasp_client.results import (
    DebugInfo,
    Detection,
    Evaluation,
    Grasp,
    Model,
    Scoring,
    StreamAnswer,
)
from edgegrasp_client.targets import object_in_scene, on_mask

__all__ = [
    "AccessDeniedError",
    "ApproachDirection",
    "AsyncGraspClient",
    "Box",
    "Collision",
    "Cone",
    "DeadlineError",
    "DebugInfo",
    "DepthImage",
    "DetectOptions",
    "Detection",
    "Evaluation",
    "Grasp",
    "GraspClient",
    "GraspClientError",
    "GripperGeometry",
    "HalfSpace",
    "HandPart",
    "Indices",
    "Intrinsics",
    "InvalidRequestError",
    "Linkage",
    "Mask",
    "Model",
    "OrientedBox",
    "OverloadedError",
    "PayloadTooLargeError",
    "PointCloud2",
    "PointField",
    "ProtocolError",
    "RansacPlane",
    "Region",
    "Scoring",
    "Segments",
    "ServerFailedError",
    "ServerUnavailableError",
    "Sphere",
    "StreamAnswer",
    "StreamRequest",
    "SupportPlane",
    "Suppression",
    "Tls",
    "UnknownModelError",
    "Workspace",
    "object_in_scene",
    "on_mask",
]
