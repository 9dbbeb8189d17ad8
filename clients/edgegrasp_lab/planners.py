"""Planners for clutter removal: a detector on a server or in this process, or a named planner."""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, NamedTuple, cast

from edgegrasp_cli.detect import InProcessDetector
from edgegrasp_client import GraspClientError, Model, ServerUnavailableError, StartCollisionError
from edgegrasp_client.connection import local_server
from edgegrasp_lab.flags import PlannerFlags
from edgegrasp_model.errors import StartCollision
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trial import PlannedGrasp, Planner, StartCollides

GROUP = "edgegrasp.planners"  # entry points under which packages may name their planners
SHIPPED = ("server", "in-process")


class ChosenPlanner(NamedTuple):
    """A factory of planners, and its description."""

    make: Callable[[], Planner]  # called in the process that uses the planner; picklable
    facts: dict[str, Any]  # for the manifest


@contextmanager
def open_planner(
    choice: PlannerFlags, rules: PlanningRules, options: Mapping[str, Any]
) -> Iterator[ChosenPlanner]:
    """Find a planner for a protocol; a server started for it runs for the duration of the context.

    `options` are for each request, and override the protocol's.

    Raises:
        ValueError: no such planner, or no such file of weights.
        EdgeGraspError: weights that cannot be used.
        GraspClientError: the server does not answer.
    """
    if choice.planner not in SHIPPED:
        unseen = options.keys() - {"gripper", "robot", "collision"}
        if choice.model or choice.weights or choice.server or unseen:
            given = "leave out --model, --weights, --server and options, which it does not get"
            raise ValueError(f"planner is {choice.planner}; {given}")
        _loaded(choice.planner)  # fails here on a wrong name, not in every worker
        yield ChosenPlanner(partial(named_planner, choice.planner), {"name": choice.planner})
        return
    weights, model = [path.resolve() for path in choice.weights], choice.model
    if choice.server and (weights or choice.planner == "in-process"):
        raise ValueError(f"server is {choice.server}; leave out --weights and --planner in-process")
    if model.endswith(".safetensors"):
        if choice.server:
            raise ValueError(f"model is {model}; name one of the server's own weights")
        if not (file := Path(model).resolve()).is_file():
            raise ValueError(f"model is {model}; there is no such file")
        weights, model = [*weights, file], file.stem
    asked = {"model": model, **options}
    with ExitStack() as stack:
        open_client: Callable[[], Any]
        if choice.planner == "in-process":
            open_client = partial(_OneThread, weights, robot=choice.robot)
        else:
            flags = [text for path in weights for text in ("--weights", str(path))]
            if choice.robot is not None:
                flags += ["--robots", choice.robot]
            address = choice.server or stack.enter_context(local_server(*flags)).grpc_address
            open_client = partial(choice.connect, address)
        with closing(open_client()) as client:
            used = model_used(client, model)
        facts: dict[str, Any] = {"name": choice.planner, "options": dict(options)}
        facts |= {"model": used.name, "digest": used.digest, "voxel_size": used.voxel_size}
        if not choice.server:
            from edgegrasp_model.scene.segment import WEIGHTS

            facts["scene_digest"] = hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
        make = partial(ClientPlanner, open_client, rules, asked, choice.timeout)
        yield ChosenPlanner(make, facts)


def named_planner(name: str) -> Planner:
    """The planner with a name: `module:attribute`, or an entry point of `edgegrasp.planners`.

    A class is called without arguments. Raises ValueError if there is no such planner.
    """
    found = _loaded(name)
    return cast("Planner", found() if isinstance(found, type) else found)


def _loaded(name: str) -> Any:
    installed = entry_points(group=GROUP)
    try:
        if name in installed.names:
            found = installed[name].load()
        elif all(name.partition(":")):
            found = EntryPoint(name, name, GROUP).load()
        else:
            known = ", ".join([*SHIPPED, *sorted(installed.names)])
            raise ValueError(f"planner is {name!r}; choose one of {known}, or module:callable")
    except (ImportError, AttributeError) as error:
        fix = "its folder must be in PYTHONPATH, or its package installed"
        raise ValueError(f"planner {name!r} cannot be loaded: {error}; {fix}") from error
    if not callable(found):
        raise ValueError(f"planner {name!r} is not callable; name a function or a class")
    return found


class _OneThread(InProcessDetector):
    """A detector on one thread, so that results do not depend on the number of threads."""

    def detect(self, cloud: Any = None, **options: Any) -> Any:
        from edgegrasp_model.scene.segment import one_thread

        with one_thread():
            return super().detect(cloud, **options)


class ClientPlanner:
    """Requests the best grasp of each observation; waits while a server restarts."""

    def __init__(
        self,
        open_client: Callable[[], Any],  # returns a GraspClient or an InProcessDetector
        rules: PlanningRules,  # of the protocol
        options: Mapping[str, Any],  # of each request, besides the protocol's
        timeout: float,  # seconds
    ) -> None:
        self.client, self.rules, self.options, self.timeout = open_client(), rules, options, timeout
        self.close = self.client.close

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The best grasp; None if there is none.

        Raises:
            GraspClientError: the server refuses the request, or is unavailable for `timeout`.
            EdgeGraspError: the detector in this process refuses it.
        """
        options = request_options(observation, seed, self.rules, self.options)
        views = observation.view_ids if len(observation.camera_positions) > 1 else None
        ask = partial(self.client.detect, observation.image, view_ids=views, **options)
        try:
            try:
                grasps = ask().grasps
            except ServerUnavailableError:
                self.client.wait_until_ready(self.timeout)
                grasps = ask().grasps
        except (StartCollision, StartCollisionError) as error:
            raise StartCollides(str(error)) from None
        if not grasps:
            return None
        best = grasps[0]  # for an arm, grasps with a motion are first
        motion = best.arm.trajectory if best.arm is not None else None
        if "robot" in options and motion is None:
            return None
        return PlannedGrasp(best.T_cloud_hand, best.score, best.width, motion)


def model_used(client: Any, name: str) -> Model:
    """The model with a name, the default if empty; raises GraspClientError if there is none."""
    models: list[Model] = client.models()
    for model in models:
        if model.name == name or (model.default and not name):
            return model
    known = ", ".join(model.name for model in models)
    raise GraspClientError(f"model is {name!r}; choose one of {known}")


def request_options(
    observation: Observation, seed: int, rules: PlanningRules, extra: Mapping[str, Any]
) -> dict[str, Any]:
    """Options of a detection under a protocol; `extra` options override them.

    The simulator's world frame is the cloud's frame, so that T_cloud_hand is T_world_hand.
    """
    low, high = observation.workspace.tolist()
    positions = observation.camera_positions.tolist()
    plane = {"normal": (0.0, 0.0, 1.0), "offset": observation.table_height}
    support = plane | {"max_depth_error": rules.max_depth_error}
    options: dict[str, Any] = {
        "seed": seed,
        "num_approach_points": rules.num_approach_points,
        "num_candidates": rules.num_candidates,
        "viewpoint": positions[0] if len(positions) == 1 else positions,
        "top_k": 1,
        "min_score": rules.min_score,
    }
    if observation.table != "auto":  # the detector finds them itself
        options |= {"support": support, "workspace": {"min": low, "max": high}}
    return options | dict(extra)
