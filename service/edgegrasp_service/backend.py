"""What the service needs of whatever finds grasps: the weights' catalogue, or the dummy."""

from collections.abc import Mapping, Sequence, Sized
from typing import Any, Protocol

from numpy.typing import NDArray

from edgegrasp_model.options import DetectOptions
from edgegrasp_model.results import Detection, Scoring
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_service.settings import Settings


class Batch(Protocol):
    """What the network is to score."""

    @property
    def num_balls(self) -> int:
        """Balls."""

    @property
    def points(self) -> Sized:
        """Points of all balls."""

    @property
    def contact(self) -> Sized:
        """What of each candidate; the network gives a logit for each."""

    @staticmethod
    def concatenate(batches: Sequence[Any]) -> Any:
        """One batch of several, in order."""


class Prepared(Protocol):
    """A request between the stages."""

    @property
    def batch(self) -> Batch | None:
        """None: there is nothing to score."""

    @property
    def seconds(self) -> dict[str, float]:
        """Spent in each stage."""


class Detector(Protocol):
    """Finds grasps in a cloud with one set of weights, in three stages; of any thread."""

    def prepare(self, cloud: CloudInput, options: DetectOptions) -> Prepared:
        """What comes before the network; raises InvalidRequest for a cloud that does not suit."""

    def run(self, batch: Any) -> NDArray[Any]:
        """The network: a logit for each candidate of a batch, of one request or of several."""

    def finish(self, prepared: Any, logits: NDArray[Any]) -> Detection:
        """What comes after the network."""

    def score(
        self,
        cloud: CloudInput,
        options: DetectOptions,
        *,
        edges: NDArray[Any] | None = None,
        hand_poses: NDArray[Any] | None = None,
    ) -> Scoring:
        """Score edges (M, 2) or hand poses (M, 4, 4); raises InvalidRequest as `prepare`."""


class Catalogue(Protocol):
    """Detectors by the name of their weights."""

    def get(self, name: str = "") -> Detector:
        """The detector of that name, the default for ""; raises UnknownModel."""

    def describe(self) -> Sequence[Mapping[str, Any]]:
        """The facts of each set of weights, keyed as the fields of ModelInfo."""

    def warm_up(self) -> None:
        """Run every detector once, so that the first request is not the slowest."""


def load_backend(settings: Settings) -> Catalogue:
    """Load what `settings.backend` names; takes seconds for weights.

    Raises:
        EdgeGraspError: Weights cannot be used, or the device is not there.
    """
    if settings.backend == "dummy":
        from edgegrasp_service.dummy import DummyCatalogue

        return DummyCatalogue(settings.dummy_seconds)
    # Torch takes seconds to import, and the ports should answer meanwhile.
    from edgegrasp_model.detector import ModelCatalogue, choose_device

    return ModelCatalogue.load(
        settings.weights,
        settings.default_model,
        choose_device(settings.device),
        settings.grippers,
    )
