"""From the planner that the command line names to a planner and its entry in the manifest."""

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

from edgegrasp_cli.flags import connect
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trial import Planner

GROUP = "edgegrasp.planners"  # entry points under which packages may name their planners
SHIPPED = ("server", "in-process")
CONNECT_SECONDS = 30.0
SUFFIX = ".safetensors"


@dataclass(frozen=True)
class PlannerChoice:
    """A planner as the command line names it."""

    name: str  # one of SHIPPED, an installed one, or `module:callable`
    model: str = ""  # weights by name, or a `.safetensors` file; empty: the default
    weights: tuple[Path, ...] = ()  # files or folders besides those that ship
    server: str | None = None  # `host:port` or `http://host:port`; None: one is started
    connection: dict[str, Any] = field(default_factory=dict)  # arguments of `connect`
    # Of each request, in place of the protocol's.
    options: dict[str, Any] = field(default_factory=dict)

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


@dataclass(frozen=True)
class ChosenPlanner:
    """How to make a planner, and what it is."""

    make: Callable[[], Planner]  # in the process that uses it; can be sent to another
    facts: dict[str, Any]  # for the manifest

    @property
    def title(self) -> str:
        """The weights' name where there are any, else the planner's."""
        return str(self.facts.get("model") or self.facts["name"])


@contextmanager
def open_planner(choice: PlannerChoice, rules: PlanningRules) -> Iterator[ChosenPlanner]:
    """Find a planner for a protocol; a server of its own runs as long as the context.

    Raises:
        ValueError: no such planner, or no such file of weights.
        EdgeGraspError: weights that cannot be used.
        GraspClientError: the server does not answer.
    """
    if choice.name == "server":
        with _server(choice, rules) as planner:
            yield planner
    elif choice.name in SHIPPED:
        yield _in_this_process(choice, rules)
    else:
        make = partial(named_planner, choice.name)
        make()  # a wrong name fails here, not in every worker
        yield ChosenPlanner(make, {"name": choice.name})


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


@contextmanager
def _server(choice: PlannerChoice, rules: PlanningRules) -> Iterator[ChosenPlanner]:
    from edgegrasp_cli.planners.detection import ServerPlanner, model_used
    from edgegrasp_client.connection import Addresses, local_server

    if choice.server and choice.model.endswith(SUFFIX):
        raise ValueError(f"model is {choice.model}; name one of the server's own weights")
    weights, model = choice.weights_and_model()
    flags = [text for path in weights for text in ("--weights", str(path))]
    own = nullcontext(Addresses("", choice.server)) if choice.server else local_server(*flags)
    with own as addresses:
        address = addresses.grpc_address
        with connect(address, CONNECT_SECONDS, **choice.connection) as client:
            used = model_used(client, model)
        asked = {"model": model, **choice.options}
        yield ChosenPlanner(
            partial(ServerPlanner, address, rules, asked, choice.connection),
            {
                "name": "server",
                "model": used.name,
                "digest": used.digest,
                "voxel_size": used.voxel_size,
                "options": choice.options,
            },
        )


def _in_this_process(choice: PlannerChoice, rules: PlanningRules) -> ChosenPlanner:
    from edgegrasp_cli.planners.detection import InProcessPlanner
    from edgegrasp_model.detector import ModelCatalogue

    weights, model = choice.weights_and_model()
    used = ModelCatalogue.load(weights).get(model).metadata
    facts = {
        "name": choice.name,
        "model": used.name,
        "digest": used.digest,
        "options": choice.options,
    }
    return ChosenPlanner(partial(InProcessPlanner, weights, model, rules, choice.options), facts)
