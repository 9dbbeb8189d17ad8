"""The service itself, without a transport: admit, decode, prepare, network, finish."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import Future
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.results import Detection, Scoring
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.admission import Admission, Place
from edgegrasp_service.backend import Catalogue, Detector, Prepared
from edgegrasp_service.batching import BatchPolicy
from edgegrasp_service.call import Call, deadline_exceeded
from edgegrasp_service.errors import (
    STOPPING,
    DetectorFailed,
    NotReady,
    PayloadTooLarge,
    WorkerLost,
)
from edgegrasp_service.given_grasps import GivenGrasps
from edgegrasp_service.network_worker import LOST, Job, NetworkWorker, out_of_memory
from edgegrasp_service.observer import Observer
from edgegrasp_service.sent_cloud import SentCloud, decode_cloud
from edgegrasp_service.settings import Settings
from edgegrasp_service.stage_pools import StagePools, Step, Steps

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Written = TypeVar("Written")


def as_it_is(answer: Any) -> Any:
    """What is written of an answer where nothing is: itself."""
    return answer


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
class Decoded:
    """What is left of a request once its cloud is decoded, and what answers it."""

    detector: Detector
    cloud: CloudInput
    options: DetectOptions
    given: GivenGrasps


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
    device: str = ""


class GraspService:
    """Answers requests with the detectors of one catalogue.

    Requests go from stage to stage in threads, one network runs at a time, and every stage begins
    only where the answer is still wanted.

    Args:
        load: Makes the catalogue; called by `start` and `reload`, in a thread.
        settings: Its bounds and how it batches.
        observer: Told of what happens.
    """

    def __init__(
        self,
        load: Callable[[], Catalogue],
        settings: Settings | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self.observer = observer or Observer()
        self.stopping = asyncio.Event()  # set: new requests are refused
        self._load = load
        self._catalogue: Catalogue | None = None
        self._admission = Admission(
            self.settings.max_concurrent_requests, self.settings.max_queue_length, self.observer
        )
        self._worker = NetworkWorker(BatchPolicy.from_settings(self.settings), self.observer)
        self._pools = StagePools(self.settings.prepare_threads, self._worker, self.observer)

    async def start(self) -> None:
        """Load and warm up; ready once this returns.

        Raises:
            EdgeGraspError: Weights cannot be used.
        """
        self._worker.start()
        await self.reload()

    async def reload(self) -> None:
        """Load anew and warm up; requests that come after that get what was loaded.

        Those that are in the server finish with what they began with.

        Raises:
            EdgeGraspError: Weights cannot be used; those at hand stay in use.
        """
        loop = asyncio.get_running_loop()
        self._catalogue = await loop.run_in_executor(None, self._load_and_warm_up)

    @property
    def ready(self) -> bool:
        """Whether requests are answered."""
        return self._catalogue is not None and not self.stopping.is_set()

    def stop_accepting(self) -> None:
        """Refuse new requests; those accepted still finish."""
        self.stopping.set()

    async def drain(self, grace: float) -> bool:
        """Refuse new requests, and wait for those accepted.

        Args:
            grace: Seconds to wait at most.

        Returns:
            Whether every one of them has ended.
        """
        self.stop_accepting()
        try:
            async with asyncio.timeout(grace):
                await self._admission.empty()
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        """Stop the threads once what they run now is done; what waits fails as not ready."""
        self._pools.close()
        self._worker.close()

    def check_open(self) -> None:
        """Pass where there is a place for one more request.

        Raises:
            NotReady: Weights are not loaded yet, or the server is stopping.
            Overloaded: There is no place.
        """
        self._ready_catalogue()
        self._admission.check_room()

    def admit(self, call: Call) -> Place:
        """Take a place for a call, a context manager; before anything is read of it.

        Raises:
            NotReady: Weights are not loaded yet, or the server is stopping.
            Overloaded: There is no place, or its turn would come too late.
        """
        self._ready_catalogue()
        call.limit(self.settings.max_request_seconds)
        call.check()
        return self._admission.enter(call)

    async def detect(
        self,
        read: Callable[[], DetectRequest],
        place: Place,
        write: Callable[[Detection], Written] = as_it_is,
    ) -> Written:
        """Find grasps.

        Args:
            read: Makes the request of what was sent; called in a thread, as `write` is.
            place: Its place.
            write: Makes what is sent of the grasps.

        Raises:
            EdgeGraspError: One of the errors in the table of `edgegrasp_service.errors`.
        """
        call = place.call
        options: list[DetectOptions] = []  # known once they are read

        def steps() -> Steps:
            asked: Decoded = yield Step("decode", lambda: self._decoded(read(), options))
            detector = asked.detector
            prepared: Prepared = yield Step(
                "prepare", partial(detector.prepare, asked.cloud, asked.options)
            )
            del asked  # nothing here keeps what was read: as JSON it takes many times its room
            logits, seconds = np.empty(0, np.float32), 0.0
            if prepared.batch is not None:
                logits, seconds = yield Job(call, detector, prepared.batch)
            prepared.seconds["network"] = seconds
            detection = yield Step("finish", partial(detector.finish, prepared, logits))
            return detection, write(detection)

        written: Written = await self._answer(steps(), place, options)
        return written

    async def score(
        self,
        read: Callable[[], ScoreRequest],
        place: Place,
        write: Callable[[Scoring], Written] = as_it_is,
    ) -> Written:
        """Score edges or hand poses that the caller gives; arguments and errors as of `detect`."""
        options: list[DetectOptions] = []

        def checked() -> ScoreRequest:
            request = read()
            request.given.check()
            for name, given in vars(request.given).items():
                _limit(name, 0 if given is None else len(given), self.settings.max_candidates)
            return request

        def steps() -> Steps:
            asked: Decoded = yield Step("decode", lambda: self._decoded(checked(), options))
            edges, poses = asked.given.edges, asked.given.hand_poses
            score = partial(asked.detector.score, asked.cloud, asked.options)
            work = partial(score, edges=edges, hand_poses=poses)
            scoring = yield Job(place.call, work=work)
            return scoring, write(scoring)

        written: Written = await self._answer(steps(), place, options)
        return written

    async def _answer(self, steps: Steps, place: Place, options: list[DetectOptions]) -> Any:
        """Take a request through its steps, in its turn and before its deadline."""
        call = place.call

        def work() -> Future[Any]:
            self.observer.stage(call, "admission", call.seconds)
            answer = self._pools.begin(call, steps)
            named = copy_context()  # with the request's id
            answer.add_done_callback(lambda ended: named.run(_log_fault, ended, call, options))
            return answer

        try:
            answer, written = await in_time(call, place.begin(work))
        except EdgeGraspError:
            raise
        except Exception as error:
            if out_of_memory(error):
                raise WorkerLost(LOST) from None
            raise DetectorFailed("The detector failed; the server's log says why.") from None
        # Once it is on its way.
        asyncio.get_running_loop().call_soon(self.observer.answered, call, answer)
        return written

    def _decoded(self, request: DetectRequest, known: list[DetectOptions]) -> Decoded:
        """A request within the bounds, with its cloud decoded; its options are `known` first."""
        options = parse_options(dict(request.options))
        known.append(options)
        _limit("options.num_approach_points", options.num_approach_points, self.settings.max_balls)
        _limit("options.num_candidates", options.num_candidates, self.settings.max_candidates)
        assert self._catalogue is not None  # or there would be no place
        detector = self._catalogue.get(options.model)
        cloud, options = decode_cloud(request.cloud, options, self.settings.max_points)
        given = request.given if isinstance(request, ScoreRequest) else GivenGrasps()
        return Decoded(detector, cloud, options, given)

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
        if self.stopping.is_set():
            raise NotReady(STOPPING)
        if self._catalogue is None:
            raise NotReady("Weights are still loading. Try again in some seconds.")
        return self._catalogue

    def _load_and_warm_up(self) -> Catalogue:
        catalogue = self._load()
        catalogue.warm_up()
        return catalogue


async def in_time(call: Call, work: Coroutine[Any, Any, Result]) -> Result:
    """Wait for something until the deadline of a call.

    Raises:
        DeadlineExceeded: It took longer; the call is cancelled.
    """
    try:
        async with asyncio.timeout(call.remaining):
            return await work
    except TimeoutError:
        call.cancel()
        raise deadline_exceeded() from None
    except asyncio.CancelledError:
        call.cancel()
        raise


def _log_fault(ended: Future[Any], call: Call, options: list[DetectOptions]) -> None:
    """Log what is no error of the caller's, also where nobody waits for the answer any more."""
    error = ended.exception()
    if error is not None and not isinstance(error, EdgeGraspError):
        logger.error("%s failed on %s", call.request_id, _describe(options), exc_info=error)


def _limit(field: str, asked: int, most: int) -> None:
    if asked > most:
        raise PayloadTooLarge(field, str(asked), f"This server takes at most {most}.")


def _describe(options: list[DetectOptions]) -> str:
    """Options as JSON; lists of rows may be long."""
    if not options:
        return "a request that is not read"
    return options[0].model_dump_json(exclude_defaults=True)[:2000]
