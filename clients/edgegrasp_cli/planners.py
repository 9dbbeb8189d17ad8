"""Planners for clutter removal: a detector, on a server or in this process, or any by name."""

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from edgegrasp_cli.flags import connect
from edgegrasp_client import (
    GraspClient,
    GraspClientError,
    Model,
    ServerUnavailableError,
    StartCollisionError,
)
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trial import PlannedGrasp, Planner, StartCollides

GROUP = "edgegrasp.planners"  # entry points under which packages may name their planners
SHIPPED = ("server", "in-process")
CONNECT_SECONDS, REQUEST_SECONDS = 30.0, 300.0
SUFFIX = ".safetensors"
MAX_DEPTH_ERROR = 0.12  # depth error for views that show the table; more than any protocol's noise


@dataclass(frozen=True)
class PlannerChoice:
    """A planner as the command line names it."""

    name: str  # one of SHIPPED, an installed one, or `module:callable`
    model: str = ""  # weights by name, or a `.safetensors` file; empty: the default
    weights: tuple[Path, ...] = ()  # files or folders besides those that ship
    server: str | None = None  # `host:port` or `http://host:port`; None: one is started
    connection: dict[str, Any] = field(default_factory=dict)  # arguments of `connect`
    # Options of each request, in place of the protocol's.
    options: dict[str, Any] = field(default_factory=dict)
    robot: str | None = None  # that the options name: one that ships, or its file

    def weights_and_model(self) -> tuple[tuple[Path, ...], str]:
        """The weights to load, and the name to ask for.

        Raises:
            ValueError: the model is a file, and there is none.
        """
        if not self.model.endswith(SUFFIX):
            return self.weights, self.model
        file = Path(self.model)
        if not file.is_file():
            raise ValueError(f"model is {self.model}; there is no such file")
        return (*self.weights, file), file.stem


class ChosenPlanner(NamedTuple):
    """A factory of planners, and its description."""

    make: Callable[[], Planner]  # in the process that uses it; can be sent to another
    facts: dict[str, Any]  # for the manifest


@contextmanager
def open_planner(choice: PlannerChoice, rules: PlanningRules) -> Iterator[ChosenPlanner]:
    """Find a planner for a protocol; a server started for it runs for the duration of the context.

    Raises:
        ValueError: no such planner, or no such file of weights.
        EdgeGraspError: weights that cannot be used.
        GraspClientError: the server does not answer.
    """
    if choice.name not in SHIPPED:
        make = partial(named_planner, choice.name)
        make()  # fails here on a wrong name, not in every worker
        yield ChosenPlanner(make, {"name": choice.name})
        return
    if choice.server and choice.model.endswith(SUFFIX):
        raise ValueError(f"model is {choice.model}; name one of the server's own weights")
    weights, model = choice.weights_and_model()
    facts: dict[str, Any] = {"name": choice.name, "options": choice.options}
    if choice.name == "in-process":
        from edgegrasp_model.detector import ModelCatalogue

        used = ModelCatalogue.load(weights).get(model).metadata
        planner = partial(InProcessPlanner, weights, model, rules, choice.options, choice.robot)
        yield ChosenPlanner(planner, facts | {"model": used.name, "digest": used.digest})
        return
    from edgegrasp_client.connection import Addresses, local_server

    flags = [text for path in weights for text in ("--weights", str(path))]
    if choice.robot is not None:
        flags += ["--robots", choice.robot]
    own = nullcontext(Addresses("", choice.server)) if choice.server else local_server(*flags)
    with own as addresses:
        address = addresses.grpc_address
        with connect(address, CONNECT_SECONDS, **choice.connection) as client:
            served = model_used(client, model)
        asked = {"model": model, **choice.options}
        facts |= {"model": served.name, "digest": served.digest, "voxel_size": served.voxel_size}
        yield ChosenPlanner(partial(ServerPlanner, address, rules, asked, choice.connection), facts)


def named_planner(name: str) -> Planner:
    """The planner of a name: `module:attribute`, or an entry point of `edgegrasp.planners`.

    A function is the planner itself; a class is called without arguments to make one.

    Raises:
        ValueError: there is no such planner.
    """
    installed = entry_points(group=GROUP)
    module, colon, attribute = name.partition(":")
    try:
        if name in installed.names:
            found = installed[name].load()
        elif module and colon and attribute:
            found = getattr(importlib.import_module(module), attribute)
        else:
            known = ", ".join([*SHIPPED, *sorted(installed.names)])
            raise ValueError(f"planner is {name!r}; choose one of {known}, or module:callable")
    except (ImportError, AttributeError) as error:
        raise ValueError(f"planner {name!r} cannot be loaded: {error}") from error
    planner: Any = found() if isinstance(found, type) else found
    if not callable(planner):
        raise ValueError(f"planner {name!r} is not callable; name a function or a class")
    return cast("Planner", planner)


@dataclass
class ServerPlanner:
    """Requests the best grasp of each observation from a server; waits while it restarts."""

    address: str  # host:port (gRPC) or http://host:port
    rules: PlanningRules  # of the protocol
    options: Mapping[str, Any]  # of each request, besides the protocol's
    connection: Mapping[str, Any]  # keyword arguments of `connect`
    _client: GraspClient | None = field(default=None, init=False)

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The server's best grasp; None if it finds none.

        Raises:
            GraspClientError: the server refuses the request, or is away for REQUEST_SECONDS.
        """
        if self._client is None:
            self._client = connect(self.address, REQUEST_SECONDS, **self.connection)
        options = request_options(observation, seed, self.rules, self.options)
        ask = partial(
            self._client.detect, observation.image, view_ids=view_ids(observation), **options
        )
        try:
            try:
                return _best(ask().grasps, options)
            except ServerUnavailableError:
                self._client.wait_until_ready(REQUEST_SECONDS)
                return _best(ask().grasps, options)
        except StartCollisionError as error:
            raise StartCollides(str(error)) from None

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()


class InProcessPlanner:
    """Returns the best grasp of a detector in this process.

    Raises:
        EdgeGraspError: the weights cannot be loaded.
    """

    def __init__(
        self,
        weights: tuple[Path, ...],
        model: str,
        rules: PlanningRules,
        options: Mapping[str, Any],
        robot: str | None = None,
    ) -> None:
        from edgegrasp_model.detector import ModelCatalogue

        self._detector = ModelCatalogue.load(weights).get(model)
        self._rules, self._options, self._robot = rules, options, robot

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The best grasp; None if there is none."""
        import torch

        from edgegrasp_model.errors import StartCollision
        from edgegrasp_model.options import parse_options
        from edgegrasp_model.scene.cloud import CloudInput

        asked = request_options(observation, seed, self._rules, self._options)
        options = parse_options(asked)
        cloud = CloudInput(observation.image, view_ids=view_ids(observation))
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # so that sums do not depend on the number of threads elsewhere
        try:
            if self._robot is None:
                return _best(self._detector.detect(cloud, options).grasps, asked)
            from edgegrasp_robot import detect_picks, load_robots

            (robot,) = load_robots((Path(self._robot),)).values()
            return _best(detect_picks(self._detector, cloud, options, robot).grasps, asked)
        except StartCollision as error:
            raise StartCollides(str(error)) from None
        finally:
            torch.set_num_threads(threads)


def model_used(client: GraspClient, name: str) -> Model:
    """The model that a request naming `name` gets; the default for an empty one.

    Raises:
        GraspClientError: the server does not answer, or has no such model.
    """
    models = client.models()
    for model in models:
        if model.name == name or (model.default and not name):
            return model
    known = ", ".join(model.name for model in models)
    raise GraspClientError(f"model is {name!r}; the server has {known}")


def request_options(
    observation: Observation, seed: int, rules: PlanningRules, extra: Mapping[str, Any]
) -> dict[str, Any]:
    """Options of a detection under a protocol; `extra` ones win.

    The simulator's world frame is the cloud's frame, so that T_cloud_hand is T_world_hand.
    """
    low, high = observation.workspace.tolist()
    positions = observation.camera_positions.tolist()
    support: dict[str, Any] = {"normal": (0.0, 0.0, 1.0), "offset": observation.table_height}
    if observation.table == "seen":
        support["max_depth_error"] = MAX_DEPTH_ERROR
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


def view_ids(observation: Observation) -> NDArray[np.int32] | None:
    """Which camera saw each point, where there are several."""
    return observation.view_ids if len(observation.camera_positions) > 1 else None


def _best(grasps: Sequence[Any], options: Mapping[str, Any]) -> PlannedGrasp | None:
    """The first of the sorted grasps; for an arm, the first with a motion."""
    if not grasps:
        return None
    best = grasps[0]
    motion = best.arm.trajectory if best.arm is not None else None
    if "robot" in options and motion is None:
        return None
    return PlannedGrasp(best.T_cloud_hand, best.score, best.width, motion)
