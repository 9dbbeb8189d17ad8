"""From what the command line names to a planner, and to how a manifest describes it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgegrasp_cli.connection import NO_CONNECTION, Connection, connect
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trials import Planner

CONNECT_SECONDS = 30.0
SUFFIX = ".safetensors"


@dataclass(frozen=True)
class PlannerChoice:
    """A planner as the command line names it.

    Attributes:
        name: `server`, `in-process`, `edge-sample`, `oracle`, `oracle-own`, an installed one, or
            `module:callable`.
        model: weights by name, or a `.safetensors` file; empty: the default.
        weights: files or folders besides those that ship.
        server: `host:port` or `http://host:port`; None: one is started.
        connection: how to know the server and what to show it; see `Connection`.
        collision: `avoid`, `penalise` or `ignore`.
        num_approach_points: None: the protocol's.
        num_candidates: None: the protocol's.
        min_score: of a grasp that is executed; without one there is another view.
        voxel_size: metres, in place of the weights' own; `in-process` only.
        flipped_normals: share of the normals turned around at random; `in-process` only.
    """

    name: str
    model: str = ""
    weights: tuple[Path, ...] = ()
    server: str | None = None
    connection: Connection = NO_CONNECTION
    collision: str = "penalise"
    num_approach_points: int | None = None
    num_candidates: int | None = None
    min_score: float = 0.0
    voxel_size: float | None = None
    flipped_normals: float = 0.0

    def overrides(self) -> dict[str, int]:
        """What of the protocol's sampling is changed."""
        given = {
            "num_approach_points": self.num_approach_points,
            "num_candidates": self.num_candidates,
        }
        return {name: value for name, value in given.items() if value is not None}

    def options(self) -> dict[str, Any]:
        """Of each request for grasps."""
        least = {"min_score": self.min_score} if self.min_score > 0.0 else {}
        return {"collision": self.collision, **self.overrides(), **least}

    def named_weights(self) -> tuple[tuple[Path, ...], str]:
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
class MadePlanner:
    """How to make a planner, and what it is.

    Attributes:
        make: makes the planner in the process that uses it; can be sent to another.
        facts: for the manifest.
    """

    make: Callable[[], Planner]
    facts: dict[str, Any]

    @property
    def title(self) -> str:
        """The weights' name where there are any, else the planner's."""
        return str(self.facts.get("model") or self.facts["name"])


@contextmanager
def planner_of(choice: PlannerChoice, rules: PlanningRules) -> Iterator[MadePlanner]:
    """Make a planner for a protocol; a server of its own runs as long as the context.

    Raises:
        ValueError: no such planner, or weights that cannot be used.
        GraspClientError: the server does not answer.
    """
    only_in_process = choice.voxel_size is not None or choice.flipped_normals > 0
    if only_in_process and choice.name != "in-process":
        raise ValueError(
            f"planner is {choice.name!r}; voxel_size and flipped_normals need in-process"
        )
    if choice.name == "server":
        with _server(choice, rules) as made:
            yield made
    elif choice.name == "in-process":
        yield _in_process(choice, rules)
    elif choice.name in ("edge-sample", "oracle"):
        yield _on_paper_candidates(choice, rules)
    elif choice.name == "oracle-own":
        yield _oracle_own(choice, rules)
    else:
        from edgegrasp_cli.planners import NamedPlanner

        named = NamedPlanner(choice.name)
        named()  # a wrong name shall fail here, not in every worker
        yield MadePlanner(named, {"name": choice.name})


def _in_process(choice: PlannerChoice, rules: PlanningRules) -> MadePlanner:
    from edgegrasp_cli.planners.in_process import InProcessPlannerFactory

    weights, model = choice.named_weights()
    used = _metadata(weights, model)
    options = choice.options()
    changes: dict[str, Any] = {}
    if choice.voxel_size is not None:
        changes["voxel_size"] = choice.voxel_size
    if choice.flipped_normals > 0:
        changes["flipped_normals"] = choice.flipped_normals
    return MadePlanner(
        InProcessPlannerFactory(weights, model, rules, options, **changes),
        {
            "name": choice.name,
            "model": used.name,
            "digest": used.digest,
            "options": options,
            **changes,
        },
    )


def _on_paper_candidates(choice: PlannerChoice, rules: PlanningRules) -> MadePlanner:
    from edgegrasp_cli.planners.edge_sample import EdgeSampleFactory
    from edgegrasp_cli.planners.oracle import MAX_TRIES, OracleFactory
    from edgegrasp_cli.planners.paper_candidates import PaperCandidates

    numbers = {
        "num_approach_points": rules.num_approach_points,
        "num_candidates": rules.num_candidates,
    } | choice.overrides()
    sampler = PaperCandidates(**numbers, voxel_size=rules.voxel_size)
    facts = {"name": choice.name, "candidates": "paper", **choice.overrides()}
    if choice.name == "edge-sample":
        return MadePlanner(EdgeSampleFactory(sampler), facts)
    return MadePlanner(OracleFactory(sampler), facts | {"max_tries": MAX_TRIES})


def _oracle_own(choice: PlannerChoice, rules: PlanningRules) -> MadePlanner:
    from edgegrasp_cli.planners.oracle import MAX_TRIES, OracleFactory
    from edgegrasp_cli.planners.own_candidates import OwnCandidates

    weights, model = choice.named_weights()
    used = _metadata(weights, model)
    options = {"collision": "avoid", **choice.overrides()}
    return MadePlanner(
        OracleFactory(OwnCandidates(rules, options, weights, model)),
        {
            "name": choice.name,
            "candidates": "own",
            "voxel_size": used.voxel_size,
            "max_tries": MAX_TRIES,
            "options": options,
        },
    )


def _metadata(weights: tuple[Path, ...], model: str) -> Any:
    """What the weights say of themselves."""
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_model.errors import EdgeGraspError

    try:
        return ModelCatalogue.load(weights).get(model).metadata
    except EdgeGraspError as error:
        raise ValueError(str(error)) from error


@contextmanager
def _server(choice: PlannerChoice, rules: PlanningRules) -> Iterator[MadePlanner]:
    from edgegrasp_cli.planners.server import ServerPlannerFactory, model_used
    from edgegrasp_client.local_server import Addresses, local_server

    if choice.server and choice.model.endswith(SUFFIX):
        raise ValueError(f"model is {choice.model}; name one of the server's own weights")
    weights, model = choice.named_weights()
    options = choice.options()
    flags = [text for path in weights for text in ("--weights", str(path))]
    own = nullcontext(Addresses("", choice.server)) if choice.server else local_server(*flags)
    with own as addresses:
        with connect(addresses.grpc_address, CONNECT_SECONDS, *choice.connection) as client:
            used = model_used(client, model)
        yield MadePlanner(
            ServerPlannerFactory(
                addresses.grpc_address,
                rules,
                {"model": model, **options},
                used.digest,
                choice.connection,
            ),
            {
                "name": "server",
                "model": used.name,
                "digest": used.digest,
                "voxel_size": used.voxel_size,
                "options": options,
            },
        )
