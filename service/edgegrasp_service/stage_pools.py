"""Threads that decode and prepare clouds and rank grasps, while another runs the network."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import Any, NamedTuple

from edgegrasp_service.call import Call
from edgegrasp_service.errors import STOPPING, NotReady, WorkerLost
from edgegrasp_service.network_worker import LOST, Job, NetworkWorker
from edgegrasp_service.observer import Observer

logger = logging.getLogger(__name__)


class Step(NamedTuple):
    """One stage of a request; its result is what the request's `Steps` are sent."""

    stage: str  # "decode", "prepare" or "finish"
    work: Callable[[], Any]


# A request: each stage in turn, or a job for the network; it returns the answer.
Steps = Generator[Step | Job, Any, Any]


@dataclass(eq=False)
class Course:
    """A request on its way through its steps."""

    call: Call
    steps: Steps
    answer: "Future[Any]"
    end: Callable[[], None] = lambda: None

    def next(self, result: Any = None, error: BaseException | None = None) -> Step | Job | None:
        """What to do after a step's result or error; None: nothing, and `end` gives the answer."""
        try:
            return self.steps.send(result) if error is None else self.steps.throw(error)
        except StopIteration as end:
            self.end = partial(self.answer.set_result, end.value)
        except BaseException as raised:
            self.end = partial(self.answer.set_exception, raised)
        return None


class StagePools:
    """Takes requests through their stages.

    The companion, one thread, goes with a request through all of them: what comes to an idle server
    changes threads once. Requests that find it busy go from one pool to the next: a large file
    delays no other's cloud, and ranking waits for neither. Stages have bounds of their own, which
    hold for pools and companion together.

    Args:
        threads: Requests that are decoded at a time, and that are prepared; one is ranked.
        worker: Runs the network.
        observer: Told how long each stage took.
    """

    def __init__(self, threads: int, worker: NetworkWorker, observer: Observer) -> None:
        self._worker = worker
        self._observer = observer
        self._closed = False
        at_a_time = {"decode": threads, "prepare": threads, "finish": 1}
        self._room = {stage: Room(many) for stage, many in at_a_time.items()}
        self._pools = {
            stage: ThreadPoolExecutor(many, thread_name_prefix=stage)
            for stage, many in at_a_time.items()
        }
        self._companion = Companion(self._accompany)

    def begin(self, call: Call, steps: Steps) -> "Future[Any]":
        """Begin a request; every stage begins only if the answer is still wanted then.

        Returns:
            What its steps return or raise, which nobody can cancel. Into the steps are raised:
            Cancelled and DeadlineExceeded, if the answer is not wanted; NotReady, if this is
            closed; WorkerLost, if something tried to end a thread; and whatever a stage raises.
        """
        course = Course(call, steps, Future())
        course.answer.set_running_or_notify_cancel()
        if self._closed or not self._companion.offer(course):
            self._go_on(course)
        return course.answer

    def close(self) -> None:
        """Stop the threads once what they run now is done; what waits fails as not ready."""
        self._closed = True
        self._companion.close()
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)

    def _accompany(self, course: Course) -> bool:
        """Take a request through all steps in this thread; False: the thread should end.

        It waits at a stage that others fill, as it would in that stage's pool.
        """
        healthy = True
        step = course.next()
        while step is not None:
            result = error = None
            try:
                if isinstance(step, Job):
                    result = self._worker.here(step)
                else:
                    result = self._stage(course.call, step)
            except BaseException as raised:
                error = raised
                healthy = not isinstance(raised, WorkerLost)
            del step  # it holds what the stage worked on
            step = course.next(result, error)
        return healthy

    def _go_on(
        self, course: Course, result: Any = None, error: BaseException | None = None
    ) -> None:
        """Hand a request on to the pool of its next step; the thread that ended the last one does.

        The event loop, which has others to wake for, hears of the answer only.
        """
        if (step := course.next(result, error)) is None:
            course.end()
        else:
            self._submit(course.call, step).add_done_callback(partial(self._ended, course))

    def _ended(self, course: Course, step: "Future[Any]") -> None:
        if step.cancelled():  # by pools that close
            self._go_on(course, error=NotReady(STOPPING))
        elif (error := step.exception()) is not None:
            self._go_on(course, error=error)
        else:
            self._go_on(course, step.result())

    def _submit(self, call: Call, step: Step | Job) -> "Future[Any]":
        try:
            if isinstance(step, Job):
                return self._worker.submit(step)
            return self._pools[step.stage].submit(self._stage, call, step)
        except Exception as error:  # NotReady, or a pool's own RuntimeError
            failed: Future[Any] = Future()
            failed.set_exception(NotReady(STOPPING) if self._closed else error)
            return failed

    def _stage(self, call: Call, step: Step) -> Any:
        """Do a step when there is room in its stage."""
        with self._room[step.stage]:
            if self._closed:
                raise NotReady(STOPPING)
            call.check()
            start = time.perf_counter()
            try:
                return step.work()
            except Exception:
                raise
            except BaseException:  # a SystemExit would end the event loop that waits for this
                logger.exception("the stage %s was ended", step.stage)
                raise WorkerLost(LOST) from None
            finally:
                self._observer.stage(call, step.stage, time.perf_counter() - start)


class Room:
    """A context for so many threads at a time, first come, first served.

    A semaphore's thread that leaves and comes again would overtake those that wait, for ever.
    """

    def __init__(self, threads: int) -> None:
        self._free = threads
        self._turns: deque[threading.Lock] = deque()
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        with self._lock:
            if self._free:
                self._free -= 1
                return
            turn = threading.Lock()
            turn.acquire()
            self._turns.append(turn)
        turn.acquire()

    def __exit__(self, *error: object) -> None:
        with self._lock:
            if self._turns:
                self._turns.popleft().release()  # `_free` stays: one leaves, one comes
            else:
                self._free += 1


class Companion:
    """A thread that takes one request at a time; it is replaced where it dies.

    Args:
        accompany: What it does with a request; False: this thread should end.
    """

    def __init__(self, accompany: Callable[[Course], bool]) -> None:
        self._accompany = accompany
        self._courses: SimpleQueue[Course | None] = SimpleQueue()
        self._idle = True
        self._start()

    def offer(self, course: Course) -> bool:
        """Hand a request over; False: it has one already. Of one thread only, the event loop's."""
        if not self._idle:
            return False
        self._idle = False
        self._courses.put(course)
        return True

    def close(self) -> None:
        """End the thread when it has done what it does now."""
        self._idle = False
        self._courses.put(None)

    def _start(self) -> None:
        threading.Thread(target=self._main, name="companion", daemon=True).start()

    def _main(self) -> None:
        while (course := self._courses.get()) is not None:
            healthy = self._accompany(course)
            if not healthy:
                self._start()
            self._idle = True  # before there is an answer, as the next request may come right after
            course.end()
            del course
            if not healthy:
                return
