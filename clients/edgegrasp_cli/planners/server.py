"""The planner that asks a grasp-detection server."""

from dataclasses import dataclass
from typing import Any

from edgegrasp_cli.connection import NO_CONNECTION, Connection, connect
from edgegrasp_cli.planners.requests import choose, request_options
from edgegrasp_client import (
    DeadlineError,
    Detection,
    GraspClient,
    GraspClientError,
    Model,
    ServerUnavailableError,
)
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.protocol import PlanningRules
from edgegrasp_sim.trial import PlannedGrasp, PlannerUnavailableError

REQUEST_SECONDS = 120.0


@dataclass(frozen=True)
class ServerPlannerFactory:
    """Makes a planner with a connection of its own in each worker process.

    Attributes:
        address: host:port (gRPC) or http://host:port.
        rules: of the protocol.
        options: of each request, besides the protocol's.
        digest: of the weights that the server shall answer with.
        connection: how to know the server and what to show it; see `Connection`.
    """

    address: str
    rules: PlanningRules
    options: dict[str, Any]
    digest: str
    connection: Connection = NO_CONNECTION

    def __call__(self) -> "ServerPlanner":
        """A planner for this server."""
        return ServerPlanner(self)


class ServerPlanner:
    """Asks a server for the best grasp of each observation.

    A server that went away may come back at the same address: the connection is made anew, and
    its weights must be the same as before.
    """

    def __init__(self, settings: ServerPlannerFactory) -> None:
        self.settings = settings
        self._client: GraspClient | None = None

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The server's best grasp; None where it finds none.

        Raises:
            PlannerUnavailableError: no answer; asking again may help.
            GraspClientError: the server refuses the request, or has other weights than before.
        """
        rules = self.settings.rules
        options = request_options(observation, seed, rules, self.settings.options)
        if len(observation.camera_positions) > 1:
            options["view_ids"] = observation.view_ids
        try:
            client = self._connected()
            detection: Detection = client.detect(observation.cloud, **options)
        except (ServerUnavailableError, DeadlineError) as error:
            self.close()
            raise PlannerUnavailableError(f"{self.settings.address}: {error}") from None
        best = choose(detection.grasps, rules, observation.failed)
        return PlannedGrasp(best.T_cloud_hand, best.score, best.width) if best else None

    def close(self) -> None:
        """Close the connection; the next request opens it anew."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def _connected(self) -> GraspClient:
        if self._client is None:
            self._client = connect(
                self.settings.address, REQUEST_SECONDS, *self.settings.connection
            )
            used = model_used(self._client, self.settings.options.get("model", ""))
            if used.digest != self.settings.digest:
                raise GraspClientError(
                    f"{self.settings.address} now has other weights for {used.name} (digest "
                    f"{used.digest[:12]}, not {self.settings.digest[:12]}); restart it with those "
                    "the benchmark began with"
                )
        return self._client


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
