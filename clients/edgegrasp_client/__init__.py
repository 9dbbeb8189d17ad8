"""Python client of the grasp-detection service, over gRPC or REST.

from edgegrasp_client import GraspClient

with GraspClient("127.0.0.1:50051") as client:  # or "http://127.0.0.1:8000"
    detection = client.detect(points, seed=7, top_k=5)
best = detection.grasps[0]
"""

from edgegrasp_camera.clouds import PointCloud2 as PointCloud2
from edgegrasp_camera.clouds import PointField as PointField
from edgegrasp_camera.depth import Intrinsics as Intrinsics
from edgegrasp_client.client import AsyncGraspClient as AsyncGraspClient
from edgegrasp_client.client import GraspClient as GraspClient
from edgegrasp_client.connection import Tls as Tls
from edgegrasp_client.errors import *  # noqa: F403
from edgegrasp_client.options import *  # noqa: F403  # the names of its `__all__`
from edgegrasp_client.requests import DepthImage as DepthImage
from edgegrasp_client.requests import RequestFields as RequestFields
from edgegrasp_client.requests import StreamRequest as StreamRequest
from edgegrasp_client.requests import object_in_scene as object_in_scene
from edgegrasp_client.requests import on_mask as on_mask
from edgegrasp_client.results import Model as Model
from edgegrasp_client.results import Robot as Robot
from edgegrasp_client.results import StreamAnswer as StreamAnswer
from edgegrasp_client.tracker import GraspTracker as GraspTracker
from edgegrasp_results import DebugInfo as DebugInfo
from edgegrasp_results import DetectedObject as DetectedObject
from edgegrasp_results import Detection as Detection
from edgegrasp_results import Evaluation as Evaluation
from edgegrasp_results import Grasp as Grasp
from edgegrasp_results import GripperOutline as GripperOutline
from edgegrasp_results import Scoring as Scoring
from edgegrasp_results import Tracking as Tracking
