"""Run independent tasks in this process, in several processes, or on a Ray cluster."""

import atexit
import ctypes
import importlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, nullcontext
from functools import lru_cache
from itertools import islice
from typing import Any, TypeAlias, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
# Makes the callable that does a task, in the process that uses it; picklable for other processes.
MakeRunner: TypeAlias = Callable[[], Callable[[Task], Result]]

MAX_CRASHES = 3  # of processes in a row, without a result in between; of one task on a cluster
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PR_SET_PDEATHSIG = 1  # of Linux's prctl
LOCAL_RAY = "local"  # address of a cluster that is started on this machine for the run


class WorkerError(RuntimeError):
    """Worker processes or a cluster cannot run the tasks."""


def run_tasks(
    make_runner: MakeRunner[Task, Result],  # called once in every process
    tasks: Sequence[Task],
    *,
    workers: int | None = None,  # at a time; 1: in this process; None: all cores
    ray: str | None = None,  # address of a cluster, as in `ray.init`; `local` starts one
) -> Iterator[tuple[Task, Result]]:
    """Run independent tasks, again if a worker dies; yields each task with its result."""
    if workers is not None and workers < 1:
        raise ValueError(f"workers is {workers}; use at least 1")
    if not tasks:
        return iter(())
    if ray is not None:
        return _on_ray(ray, make_runner, tasks, workers)
    processes = min(workers or len(os.sched_getaffinity(0)), len(tasks))
    if processes > 1:
        return _in_processes(make_runner, tasks, processes)
    return _here(make_runner, tasks)


def _here(
    make_runner: MakeRunner[Task, Result], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result]]:
    run: Any = make_runner()
    with closing(run) if hasattr(run, "close") else nullcontext():
        for task in tasks:
            yield task, run(task)


def _in_processes(
    make_runner: MakeRunner[Task, Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, Result]]:
    """Run in a pool of processes; when one dies, a new pool takes over."""
    missing, crashes = list(tasks), 0
    made = pickle.dumps(make_runner)
    while missing:
        # Forked children would share the parent's physics servers.
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, context, initializer=_start_process)
        try:
            futures = {pool.submit(_run, made, task): task for task in missing}
            for future in as_completed(futures):
                result, task = future.result(), futures[future]
                crashes = 0
                missing.remove(task)
                yield task, result
        except (KeyboardInterrupt, GeneratorExit):  # results would be lost anyway
            for process in list(pool._processes.values()):
                process.terminate()
            raise
        except BrokenProcessPool:
            crashes += 1
            if crashes >= MAX_CRASHES:
                raise WorkerError(
                    f"worker processes died {crashes} times in a row with {len(missing)} tasks "
                    "left; run with one worker to see why"
                ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _start_process() -> None:
    for name in THREADS:  # all cores are busy anyway
        os.environ.setdefault(name, "1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)  # end with the parent in any case


def _run(made: bytes, task: Any) -> Any:
    return _runner(made)(task)


@lru_cache(maxsize=1)
def _runner(made: bytes) -> Callable[[Any], Any]:
    runner: Any = pickle.loads(made)()
    if close := getattr(runner, "close", None):
        atexit.register(close)
    return runner  # type: ignore[no-any-return]


def _on_ray(
    address: str, make_runner: MakeRunner[Task, Result], tasks: Sequence[Task], workers: int | None
) -> Iterator[tuple[Task, Result]]:
    """Run on Ray as tasks, not actors: Ray runs the tasks of a lost machine again elsewhere."""
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError:
        raise ModuleNotFoundError("ray is not installed: pip install 'edgegrasp[ray]'") from None
    own: dict[str, Any] = {}
    if address == LOCAL_RAY:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # only read from there
        own = {"num_cpus": workers or len(os.sched_getaffinity(0)), "include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **own)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise WorkerError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        most = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        made = ray.put(ray.cloudpickle.dumps(make_runner))
        run = ray.remote(num_cpus=1, max_retries=MAX_CRASHES)(_run)
        waiting, running = iter(tasks), dict[Any, Task]()
        while True:
            for task in islice(waiting, most - len(running)):
                running[run.remote(made, task)] = task
            if not running:
                break
            (done, *_), _ = ray.wait(list(running))
            yield running.pop(done), ray.get(done)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise WorkerError(f"a Ray worker died again and again: {error}") from error
    finally:
        ray.shutdown()
