"""Requests and answers of one stream."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

from numpy.typing import NDArray

from edgegrasp_client.cloud_encoding import Cloud
from edgegrasp_client.depth_image import DepthImage
from edgegrasp_client.errors import GraspClientError
from edgegrasp_client.inputs import Inputs
from edgegrasp_client.options import DetectOptions, plain_options
from edgegrasp_client.results import Detection


class StreamRequest:
    """One request of a stream; arguments as of `GraspClient.detect`.

    Attributes:
        inputs: The cloud, and what comes with it.
        options: As plain values.
        request_id: What the answer is called; empty: the number of the request, from 0.
        timeout: Seconds until nobody wants the answer any more; None: the stream's.

    Raises:
        InvalidRequestError: There is no cloud, or more than one.
    """

    def __init__(
        self,
        cloud: Cloud | None = None,
        *,
        request_id: str = "",
        timeout: float | None = None,
        depth_images: Sequence[DepthImage] | None = None,
        normals: NDArray[Any] | None = None,
        colors: NDArray[Any] | None = None,
        segment_ids: NDArray[Any] | None = None,
        view_ids: NDArray[Any] | None = None,
        **options: Unpack[DetectOptions],
    ) -> None:
        self.inputs = Inputs(cloud, depth_images, normals, colors, segment_ids, view_ids)
        self.options = plain_options(options)
        self.request_id = request_id
        self.timeout = timeout

    def name(self, number: int) -> str:
        """Its own name, or its number in the stream."""
        return self.request_id or str(number)


@dataclass(frozen=True, eq=False)
class StreamAnswer:
    """The answer to one request of a stream: a detection or an error."""

    request_id: str
    detection: Detection | None = None
    error: GraspClientError | None = None

    def result(self) -> Detection:
        """The detection; raises the error where there is none."""
        if self.detection is None:
            assert self.error is not None
            raise self.error
        return self.detection
