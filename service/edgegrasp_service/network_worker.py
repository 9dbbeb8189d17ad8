"""The one thread that runs networks; it is replaced where it dies."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edgegrasp_service.backend import Batch, Detector
from edgegrasp_service.batching import BatchPolicy, Size
from edgegrasp_service.call import Call
from edgegrasp_service.errors import STOPPING, NotReady, WorkerLost
from edgegrasp_service.observer import Observer

logger = logging.getLogger(__name__)

LOST = "The network's worker was lost with this request, and replaced. Try again."


@dataclass(eq=False)
class Job:
    """Something that needs the network.

    It is answered with logits (E,) of its batch and the seconds the forward pass took, or with
    what its work returns.
    """

    call: Call
    detector: Detector | None = None  # its network is to score `batch`; None: `work` does it all
    batch: Batch | None = None
    work: Callable[[], Any] | None = None
    answer: Future[Any] = field(default_factory=Future)
    queued: float = field(default_factory=time.monotonic)

    @property
    def size(self) -> Size:
        """What it brings to a batch."""
        assert self.batch is not None
        return Size(self.batch.num_balls, len(self.batch.points))


class NetworkWorker:
    """Runs jobs one after the other, or several in one forward pass.

    A job that finds nothing to wait for can run in the thread that brings it. A job whose call is
    over is dropped when its turn comes. Where a forward pass of several fails,
    each is tried alone, so that one request cannot spoil the others'.
    """

    def __init__(self, policy: BatchPolicy, observer: Observer) -> None:
        self._policy = policy
        self._observer = observer
        self._jobs: list[Job] = []
        self._changed = threading.Condition()
        self._running = False
        self._closed = False

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._main, name="network", daemon=True).start()

    def submit(self, job: Job) -> "Future[Any]":
        """Let a job wait for its turn; raises NotReady once this is closed."""
        with self._changed:
            self._queue(job)
        return job.answer

    def here(self, job: Job) -> Any:
        """Run a job in the calling thread where nothing comes first, or else wait for its turn.

        Returns:
            Its answer.

        Raises:
            WorkerLost: Memory ran out, or something tried to end a thread: this one should end.
            NotReady: This is closed.
            Exception: Whatever the job raises.
        """
        with self._changed:
            now = not (self._closed or self._running or self._jobs) and self._complete(job)
            if now:
                self._running = True
            else:
                self._queue(job)
        if now:
            try:
                self._work([job])
                self._rest()
            except BaseException as error:
                self._lose([job], error)
        return job.answer.result()

    def close(self) -> None:
        """End the thread when it has done what it does now; what waits fails as not ready."""
        with self._changed:
            self._closed = True
            dropped, self._jobs = self._jobs, []
            self._changed.notify_all()
        for job in dropped:
            if job.answer.set_running_or_notify_cancel():
                job.answer.set_exception(NotReady(STOPPING))

    def _queue(self, job: Job) -> None:
        if self._closed:
            raise NotReady(STOPPING)
        self._jobs.append(job)
        self._changed.notify_all()

    def _complete(self, job: Job) -> bool:
        """Whether a job would not be joined by others if it waited."""
        return job.detector is None or self._policy.choose([job.size]).complete

    def _main(self) -> None:
        jobs: Sequence[Job] = ()
        try:
            while jobs := self._take():
                self._work(jobs)
                self._rest()
        except BaseException as error:
            self._lose(jobs, error)
            self.start()

    def _lose(self, jobs: Sequence[Job], error: BaseException) -> None:
        """Also SystemExit: whatever ends a thread, its requests end and there is a new one."""
        logger.error("the network's worker died; it is replaced", exc_info=error)
        for job in jobs:
            if not job.answer.done():
                job.answer.set_exception(WorkerLost(LOST))
        self._observer.worker_replaced(type(error).__name__)
        self._rest()

    def _rest(self) -> None:
        """Let the next jobs run."""
        with self._changed:
            self._running = False
            if self._jobs:
                self._changed.notify_all()

    def _take(self) -> Sequence[Job]:
        """Wait for the next jobs to run together; none: the worker is closed."""
        with self._changed:
            while not self._closed:
                if self._running:
                    self._changed.wait()
                elif self._jobs and (jobs := self._together()):
                    taken = {id(job) for job in jobs}
                    self._jobs = [job for job in self._jobs if id(job) not in taken]
                    self._running = True
                    return jobs
                else:
                    self._changed.wait(self._patience())
            return ()

    def _together(self) -> Sequence[Job]:
        """Those that share the next forward pass; none: it is worth a wait."""
        first = self._jobs[0]
        if first.detector is None or first.call.over:
            return [first]
        fitting = [
            job for job in self._jobs if job.detector is first.detector and not job.call.over
        ]
        choice = self._policy.choose([job.size for job in fitting])
        patience = self._patience()
        if choice.complete or patience is None or patience <= 0.0:
            return fitting[: choice.taken]
        return ()

    def _patience(self) -> float | None:
        """Seconds that the first job still waits to be joined; None: there is no job."""
        if not self._jobs:
            return None
        return self._jobs[0].queued + self._policy.max_wait - time.monotonic()

    def _work(self, jobs: Sequence[Job]) -> None:
        live = [job for job in jobs if self._wanted(job)]
        if len(live) > 1:
            try:
                self._forward(live)
                return
            except Exception:
                logger.exception("a forward pass of %d requests failed; each alone", len(live))
        lost = None
        for job in live:
            try:
                self._alone(job)
            except Exception as error:
                if out_of_memory(error):
                    lost, error = error, WorkerLost(LOST)
                job.answer.set_exception(error)
        if lost is not None:
            raise lost

    def _wanted(self, job: Job) -> bool:
        """Whether to begin; the job has ended otherwise."""
        self._observer.stage(job.call, "wait", time.monotonic() - job.queued)
        if not job.answer.set_running_or_notify_cancel():
            return False
        try:
            job.call.check()
        except Exception as error:
            job.answer.set_exception(error)
            return False
        return True

    def _alone(self, job: Job) -> None:
        if job.work is None:
            self._forward([job])
            return
        start = time.perf_counter()
        answer = job.work()
        self._observer.stage(job.call, "score", time.perf_counter() - start)
        job.answer.set_result(answer)

    def _forward(self, jobs: Sequence[Job]) -> None:
        """One forward pass; answers each of them."""
        batches = [job.batch for job in jobs if job.batch is not None]
        detector = jobs[0].detector
        assert detector is not None
        joined = batches[0] if len(batches) == 1 else batches[0].concatenate(batches)
        self._observer.batched(len(jobs), joined.num_balls, len(joined.points))
        start = time.perf_counter()
        logits = detector.run(joined)
        seconds = time.perf_counter() - start
        parts = [logits]
        if len(batches) > 1:
            parts = np.split(logits, np.cumsum([len(batch.contact) for batch in batches])[:-1])
        for job, part in zip(jobs, parts, strict=True):
            self._observer.stage(job.call, "network", seconds)
            job.answer.set_result((part, seconds))


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says so; PyTorch has a RuntimeError of its own for each device."""
    return (
        isinstance(error, MemoryError)
        or type(error).__name__ == "OutOfMemoryError"
        or "can't allocate memory" in str(error)
    )
