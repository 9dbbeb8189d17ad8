"""Answer requests: decode, detect, encode. One request at a time, in a worker process."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.job import Answer, Job, Limits


class Catalogue(Protocol):
    """Detectors by the name of their weights."""

    def get(self, name: str = "") -> Any:
        """The detector of that name, the default for ""; raises UnknownModel."""

    def describe(self) -> Sequence[Mapping[str, Any]]:
        """The facts of each set of weights."""

    def warm_up(self) -> None:
        """Run every detector once, so that the first request is not the slowest."""


def load_catalogue(settings: Settings) -> Catalogue:
    """Load the detectors that the settings name and warm them up; takes seconds.

    Raises:
        EdgeGraspError: Weights cannot be used, or the device is not there.
    """
    raise NotImplementedError


def describe(catalogue: Catalogue) -> list[dict[str, Any]]:
    """The facts of each set of weights, keyed as the fields of edgegrasp.v1.Model."""
    raise NotImplementedError


class Answerer:
    """Answers jobs with the detectors of a catalogue; holds no state between them."""

    def __init__(self, catalogue: Catalogue, limits: Limits | None = None) -> None:
        self._catalogue = catalogue
        self._limits = limits or Limits()

    def answer(self, job: Job) -> Answer:
        """Decode a job, detect, and encode the answer; every error comes back as a Problem."""
        raise NotImplementedError
