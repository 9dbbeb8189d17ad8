"""Threads that decode and prepare clouds and rank grasps, while another runs the network."""

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from edgegrasp_service.call import Call
from edgegrasp_service.errors import STOPPING, NotReady, WorkerLost
from edgegrasp_service.network_worker import LOST
from edgegrasp_service.observer import Observer

logger = logging.getLogger(__name__)

Result = TypeVar("Result")


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

    async def run(
        self, call: Call, stage: str, work: Callable[..., Result], *args: object
    ) -> Result:
        """Do something in the pool of a stage, if the answer is still wanted then.

        Raises:
            Cancelled: It is not.
            DeadlineExceeded: Nor if it came.
            NotReady: The pools are closed.
            WorkerLost: Something tried to end the thread.
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
            return await asyncio.wrap_future(self._pools[stage].submit(checked))
        except (RuntimeError, asyncio.CancelledError):
            if not self._closed:
                raise
            raise NotReady(STOPPING) from None

    def close(self) -> None:
        """Stop the threads once what they run now is done; what waits fails as not ready."""
        self._closed = True
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)
