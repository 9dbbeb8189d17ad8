"""Planners that ask a detector, on a server or in this process, and which grasp they take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_cli.flags import connect
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

if TYPE_CHECKING:  # torch is loaded by the planner that needs it
    from edgegrasp_model.options import DetectOptions
    from edgegrasp_model.scene.cloud import CloudInput

REQUEST_SECONDS = 120.0
FLIP_STREAM = 7  # random stream of one request
CHOICE = 64  # grasps to choose from where it is not the best one
NEARBY = 0.05  # metres around a grip that failed: the same object, most likely
SAME_GRIP = 0.02  # metres around it, closing the same way: the same grip again
SAME_CLOSING = np.cos(np.radians(30.0))
NEARBY_WORTH, SAME_GRIP_WORTH = 0.8, 0.6  # factors on the score
MAX_DEPTH_ERROR = 0.12  # of views that show the table; more than any protocol's noise


@dataclass
class ServerPlanner:
    """Asks a server for the best grasp of each observation.

    A server that went away may come back at the same address: the connection is made anew, and
    its weights must be the same as before.
    """

    address: str  # host:port (gRPC) or http://host:port
    rules: PlanningRules  # of the protocol
    options: Mapping[str, Any]  # of each request, besides the protocol's
    digest: str  # of the weights that the server has to answer with
    connection: Mapping[str, Any]  # keyword arguments of `connect`
    _client: GraspClient | None = field(default=None, init=False)

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The server's best grasp; None where it finds none.

        Raises:
            PlannerUnavailableError: no answer; asking again may help.
            GraspClientError: the server refuses the request, or has other weights than before.
        """
        options = request_options(observation, seed, self.rules, self.options)
        try:
            client = self._connected()
            detection: Detection = client.detect(
                observation.image, view_ids=view_ids(observation), **options
            )
        except (ServerUnavailableError, DeadlineError) as error:
            self.close()
            raise PlannerUnavailableError(f"{self.address}: {error}") from None
        return _planned(detection.grasps, self.rules, observation)

    def close(self) -> None:
        """Close the connection; the next request opens it anew."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def _connected(self) -> GraspClient:
        if self._client is None:
            # The benchmark asks again itself, for longer, and counts it.
            self._client = connect(self.address, REQUEST_SECONDS, False, **self.connection)
            used = model_used(self._client, self.options.get("model", ""))
            if used.digest != self.digest:
                raise GraspClientError(
                    f"{self.address} now has other weights for {used.name} (digest "
                    f"{used.digest[:12]}, not {self.digest[:12]}); restart it with those "
                    "the benchmark began with"
                )
        return self._client


class InProcessPlanner:
    """Takes the best grasp of a detector in this process.

    A voxel size, metres, takes the place of what the weights were trained on; a share of the
    normals is turned around at random.

    Raises:
        EdgeGraspError: the weights cannot be loaded.
    """

    def __init__(
        self,
        weights: tuple[Path, ...],
        model: str,
        rules: PlanningRules,
        options: Mapping[str, Any],
        voxel_size: float | None = None,
        flipped_normals: float = 0.0,
    ) -> None:
        from edgegrasp_model.detector import ModelCatalogue

        self._detector = ModelCatalogue.load(weights).get(model)
        if voxel_size is not None:
            self._detector.metadata = replace(self._detector.metadata, voxel_size=voxel_size)
        self._rules = rules
        self._options = options
        self._flipped_normals = flipped_normals

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The best grasp; None where there is none."""
        import torch

        from edgegrasp_model.options import parse_options
        from edgegrasp_model.scene.cloud import CloudInput

        options = parse_options(request_options(observation, seed, self._rules, self._options))
        cloud = CloudInput(observation.image, view_ids=view_ids(observation))
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # sums then do not depend on how many there are elsewhere
        try:
            if self._flipped_normals > 0:
                cloud = self._with_flipped_normals(cloud, options)
            detection = self._detector.detect(cloud, options)
        finally:
            torch.set_num_threads(threads)
        return _planned(detection.grasps, self._rules, observation)

    def _with_flipped_normals(self, cloud: "CloudInput", options: "DetectOptions") -> "CloudInput":
        """The cloud with the normals that the pipeline would find, some of them turned around.

        Normals are sent for each point and averaged in each voxel; so all points of a voxel get
        that voxel's.
        """
        scene = self._detector.prepare(cloud, options).scene
        if scene is None:
            return cloud
        rng = np.random.default_rng([options.seed, FLIP_STREAM])
        flips = rng.random(len(scene.cloud.normals)) < self._flipped_normals
        found = scene.frame.directions_in_cloud(scene.cloud.normals)
        turned = np.where(flips[:, None], -found, found).astype(np.float32)
        # The normals of points outside the kept voxels do not matter.
        up = np.array([[0.0, 0.0, 1.0]], dtype=np.float32)
        normals = np.concatenate([turned, up])[scene.point_of_row]
        return replace(cloud, normals=normals)


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
    if observation.table == "ransac":
        support = {"kind": "ransac"}
    elif observation.table == "seen":
        support["max_depth_error"] = MAX_DEPTH_ERROR
    options: dict[str, Any] = {
        "seed": seed,
        "num_approach_points": rules.num_approach_points,
        "num_candidates": rules.num_candidates,
        "viewpoint": positions[0] if len(positions) == 1 else positions,
        "top_k": 1 if rules.selection == "best" else CHOICE,
        "min_score": rules.min_score if rules.selection == "best" else 0.0,
    }
    if observation.table != "auto":  # there the detector finds out for itself
        options |= {"support": support, "workspace": {"min": low, "max": high}}
    return options | dict(extra)


def select_grasp(
    grasps: Sequence[Any], rules: PlanningRules, failed: NDArray[np.floating]
) -> Any | None:
    """The grasp a protocol takes of those given best first; None if there is none.

    `highest`: of those with `min_score` or more, if there are any, that whose TCP is highest.
    `elsewhere`: the best, where scores near grips that failed before are worth less.

    Args:
        grasps: Of the client or of the detector, best first.
        rules: Of the protocol.
        failed: (F, 4, 4) T_world_hand of the grasps of this round that failed.
    """
    if not grasps:
        return None
    if rules.selection == "highest":
        good = [grasp for grasp in grasps if grasp.score >= rules.min_score]
        return max(good or grasps[:1], key=lambda grasp: float(grasp.T_cloud_tcp[2, 3]))
    if rules.selection == "elsewhere":
        T_hand_tcp = np.linalg.inv(grasps[0].T_cloud_hand) @ grasps[0].T_cloud_tcp
        T_cloud_failed = failed @ T_hand_tcp
        return max(grasps, key=lambda grasp: _worth(grasp, T_cloud_failed))
    return grasps[0]


def view_ids(observation: Observation) -> NDArray[np.int32] | None:
    """Which camera saw each point, where there are several."""
    return observation.view_ids if len(observation.camera_positions) > 1 else None


def _planned(
    grasps: Sequence[Any], rules: PlanningRules, observation: Observation
) -> PlannedGrasp | None:
    best = select_grasp(grasps, rules, observation.failed)
    return PlannedGrasp(best.T_cloud_hand, best.score, best.width) if best else None


def _worth(grasp: Any, T_cloud_failed: NDArray[np.floating]) -> float:
    """A grasp's score, less near TCP poses (F, 4, 4) at which a grasp has failed."""
    T_cloud_tcp = grasp.T_cloud_tcp
    distance = np.linalg.norm(T_cloud_failed[:, :3, 3] - T_cloud_tcp[:3, 3], axis=1)
    closing = np.abs(T_cloud_failed[:, :3, 1] @ T_cloud_tcp[:3, 1])
    nearby = int((distance < NEARBY).sum())
    same = int(((distance < SAME_GRIP) & (closing > SAME_CLOSING)).sum())
    return float(grasp.score) * NEARBY_WORTH**nearby * SAME_GRIP_WORTH**same
