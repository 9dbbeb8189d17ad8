"""The service itself, without a transport: decode, detect in the worker thread, answer."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

from edgegrasp_model.cloud_input import CloudInput
from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.results import Detection, Scoring
from edgegrasp_service.backend import Catalogue, Detector
from edgegrasp_service.errors import DetectorFailed, NotReady
from edgegrasp_service.given_grasps import GivenGrasps
from edgegrasp_service.sent_cloud import SentCloud, decode_cloud

logger = logging.getLogger(__name__)

Answer = TypeVar("Answer", Detection, Scoring)


@dataclass(frozen=True)
class DetectRequest:
    """One request, whatever transport it came by."""

    cloud: SentCloud
    options: Mapping[str, object] = field(default_factory=dict)  # as named in DetectOptions


@dataclass(frozen=True)
class ScoreRequest(DetectRequest):
    """One request to score what the caller gives."""

    given: GivenGrasps = field(default_factory=GivenGrasps)


@dataclass(frozen=True)
class ModelInfo:
    """Loaded weights; the fields of edgegrasp.v1.Model."""

    name: str
    architecture: str = ""
    digest: str = ""
    parameters: int = 0
    crop_radius: float = 0.0  # metres
    voxel_size: float = 0.0  # metres
    gripper: str = ""
    default: bool = False
    hand_description: bool = False


class GraspService:
    """Answers requests with the detectors of one catalogue, one detection at a time.

    Args:
        load: Makes the catalogue; called in the worker thread by `start`.
        max_points: Most points accepted in a cloud.
    """

    def __init__(self, load: Callable[[], Catalogue], max_points: int) -> None:
        self._load = load
        self._max_points = max_points
        self._catalogue: Catalogue | None = None
        self._draining = False
        # Decoding a large file should not delay a detection, nor wait for one to fail.
        self._decoders = ThreadPoolExecutor(2, thread_name_prefix="decode")
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="detect")

    async def start(self) -> None:
        """Load and warm up; ready once this returns.

        Raises:
            EdgeGraspError: Weights cannot be used.
        """
        loop = asyncio.get_running_loop()
        self._catalogue = await loop.run_in_executor(self._worker, self._load_and_warm_up)

    @property
    def ready(self) -> bool:
        """Whether requests are answered."""
        return self._catalogue is not None and not self._draining

    def drain(self) -> None:
        """Refuse new requests; those accepted still finish."""
        self._draining = True

    def close(self) -> None:
        """Stop the threads once what they run now is done; what waits is dropped."""
        self._decoders.shutdown(wait=False, cancel_futures=True)
        self._worker.shutdown(wait=False, cancel_futures=True)

    async def detect(self, request: DetectRequest) -> Detection:
        """Find grasps.

        Raises:
            EdgeGraspError: One of the errors in the table of `edgegrasp_service.errors`.
        """

        def work(detector: Detector, cloud: CloudInput, options: DetectOptions) -> Detection:
            return detector.detect(cloud, options)

        return await self._answer(request, work)

    async def score(self, request: ScoreRequest) -> Scoring:
        """Score edges or hand poses that the caller gives.

        Raises:
            EdgeGraspError: One of the errors in the table of `edgegrasp_service.errors`.
        """
        request.given.check()
        edges, hand_poses = request.given.edges, request.given.hand_poses

        def work(detector: Detector, cloud: CloudInput, options: DetectOptions) -> Scoring:
            return detector.score(cloud, options, edges=edges, hand_poses=hand_poses)

        return await self._answer(request, work)

    async def _answer(
        self, request: DetectRequest, work: Callable[[Detector, CloudInput, DetectOptions], Answer]
    ) -> Answer:
        """Decode a request, then do the work in the worker thread."""
        catalogue = self._ready_catalogue()
        options = parse_options(dict(request.options))
        detector = catalogue.get(options.model)
        loop = asyncio.get_running_loop()
        try:
            cloud, options = await loop.run_in_executor(
                self._decoders, decode_cloud, request.cloud, options, self._max_points
            )
            return await loop.run_in_executor(self._worker, work, detector, cloud, options)
        except EdgeGraspError:
            raise
        except Exception:
            logger.exception("the detector failed on %s", _describe(options))
            raise DetectorFailed("The detector failed; the server's log says why.") from None

    def models(self) -> list[ModelInfo]:
        """The weights a request can name.

        Raises:
            NotReady: They are not loaded yet, or the server is stopping.
        """
        known = ModelInfo.__dataclass_fields__
        return [
            ModelInfo(**{name: value for name, value in facts.items() if name in known})
            for facts in self._ready_catalogue().describe()
        ]

    def _ready_catalogue(self) -> Catalogue:
        if self._draining:
            raise NotReady("The server is stopping. Try another one.")
        if self._catalogue is None:
            raise NotReady("Weights are still loading. Try again in some seconds.")
        return self._catalogue

    def _load_and_warm_up(self) -> Catalogue:
        catalogue = self._load()
        catalogue.warm_up()
        return catalogue


def _describe(options: DetectOptions) -> str:
    """Options as JSON; lists of rows may be long."""
    return options.model_dump_json(exclude_defaults=True)[:2000]
