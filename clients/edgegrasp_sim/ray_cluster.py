"""The rounds of a benchmark on the machines of a Ray cluster."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from edgegrasp_sim.benchmark import MAX_CRASHES, RoundRunner, objects_digest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edgegrasp_sim.benchmark import BenchmarkConfig, PlannerFactory, Task
    from edgegrasp_sim.trials import Round

LOCAL = "local"  # the address that stands for a cluster of this machine, for as long as it runs


class RayRunner(RoundRunner):
    """A simulation with a planner, for one Ray actor.

    Raises:
        ValueError: the objects on its machine are not those that the benchmark was begun with.
    """

    def __init__(self, config: BenchmarkConfig, make_planner: PlannerFactory, digest: str) -> None:
        if objects_digest(config.object_set()) != digest:
            raise ValueError(
                f"the objects in {config.objects} differ between the machines of the cluster; put "
                "the same folder at the same path on each"
            )
        super().__init__(config, make_planner)


def run_on_ray(
    address: str,
    config: BenchmarkConfig,
    make_planner: PlannerFactory,
    tasks: Sequence[Task],
    workers: int,
) -> Iterator[Round]:
    """Run rounds in the actors of a Ray cluster, as they become free.

    Each of its machines needs this package, the same objects at the same path, and what the
    planner needs. An actor that dies is started again, and its round with it.

    Args:
        address: of the cluster, as `ray.init` takes it; `local` starts one on this machine.
        config: what to run.
        make_planner: called once in every actor.
        tasks: the rounds.
        workers: actors at most; no more are started than the cluster has processors.

    Returns:
        The rounds, in the order in which they are done.

    Raises:
        RuntimeError: Ray is not installed, there is no such cluster, or actors keep dying.
    """
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError:
        raise RuntimeError("ray is not installed: pip install 'edgegrasp[ray]'") from None
    if not tasks:
        return
    _connect(ray, address, workers)
    try:
        workers = max(1, min(workers, int(ray.cluster_resources().get("CPU", 1))))
        actor: Any = ray.remote(
            num_cpus=1, max_restarts=MAX_CRASHES * len(tasks), max_task_retries=MAX_CRASHES
        )(RayRunner)
        digest = objects_digest(config.object_set())
        idle = [actor.remote(config, make_planner, digest) for _ in range(workers)]
        waiting = list(reversed(tasks))
        running: dict[Any, Any] = {}
        while waiting or running:
            while idle and waiting:
                runner = idle.pop()
                running[runner.run.remote(waiting.pop())] = runner
            (done,), _ = ray.wait(list(running))
            idle.append(running.pop(done))
            yield _result(ray, done)
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str, workers: int) -> None:
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address == LOCAL:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # only read from there
            ray.init(address=LOCAL, num_cpus=workers, include_dashboard=False, **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise RuntimeError(f"no Ray cluster at {address!r}: {error}") from error


def _result(ray: Any, done: Any) -> Round:
    """A finished round; errors as a process of our own would have raised them."""
    try:
        result: Round = ray.get(done)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayActorError as error:
        raise RuntimeError(f"a Ray actor died again and again: {error}") from error
    return result
