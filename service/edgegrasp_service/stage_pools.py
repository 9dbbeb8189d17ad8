"""Threads that decode and prepare clouds and rank grasps, while another runs the network."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from edgegrasp_service.call import Call
from edgegrasp_service.errors import STOPPING, NotReady, WorkerLost
from edgegrasp_service.network_worker import LOST
from edgegrasp_service.observer import Observer

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Following = TypeVar("Following")


class StagePools:
    """A pool for each stage: a large file delays no other's cloud, and ranking waits for neither.

    Args:
        threads: Of each, but for ranking, which has one.
        observer: Told how long each stage took.
    """

    def __init__(self, threads: int, observer: Observer) -> None:
        self._observer = observer
        self._closed = False
        self._pools = {
            "decode": ThreadPoolExecutor(threads, thread_name_prefix="decode"),
            "prepare": ThreadPoolExecutor(threads, thread_name_prefix="prepare"),
            "finish": ThreadPoolExecutor(1, thread_name_prefix="finish"),
        }

    def submit(
        self, call: Call, stage: str, work: Callable[..., Result], *args: object
    ) -> Future[Result]:
        """Do something in the pool of a stage, if the answer is still wanted then.

        Returns:
            What it gives, or one of these errors: Cancelled and DeadlineExceeded, if it is not;
            NotReady, if the pools are closed; WorkerLost, if something tried to end the thread.
        """

        def checked() -> Result:
            call.check()
            start = time.perf_counter()
            try:
                return work(*args)
            except Exception:
                raise
            except BaseException:  # a SystemExit would end the event loop that waits for this
                logger.exception("the stage %s was ended", stage)
                raise WorkerLost(LOST) from None
            finally:
                self._observer.stage(call, stage, time.perf_counter() - start)

        try:
            return self._pools[stage].submit(checked)
        except RuntimeError:
            if not self._closed:
                raise
            raise NotReady(STOPPING) from None

    def close(self) -> None:
        """Stop the threads once what they run now is done; what waits fails as not ready."""
        self._closed = True
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)


def then(
    first: Future[Result], following: Callable[[Result], Future[Following]]
) -> Future[Following]:
    """What follows the result of another future; its error, where it has one.

    The thread that ends a stage begins the next one. The event loop, which has others to wake for,
    hears of the last only.
    """
    result: Future[Following] = Future()
    result.set_running_or_notify_cancel()  # no one else may cancel it: it ends with its stages

    def ended(last: Future[Following]) -> None:
        if last.cancelled():  # by pools that close
            result.set_exception(NotReady(STOPPING))
        elif (error := last.exception()) is not None:
            result.set_exception(error)
        else:
            result.set_result(last.result())

    def begin(done: Future[Result]) -> None:
        if done.cancelled():
            result.set_exception(NotReady(STOPPING))
            return
        try:
            following(done.result()).add_done_callback(ended)
        except BaseException as error:
            result.set_exception(error)

    first.add_done_callback(begin)
    return result
