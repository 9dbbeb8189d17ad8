"""Which of the requests that wait for the network share its next forward pass."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

from edgegrasp_service.settings import Settings


class Size(NamedTuple):
    """What a request brings to a forward pass."""

    balls: int
    points: int  # of its balls


class Choice(NamedTuple):
    """How many to take, and whether more could join them."""

    taken: int
    complete: bool  # waiting would not make it better


@dataclass(frozen=True)
class BatchPolicy:
    """How batches are formed; without arguments, of one request each."""

    max_balls: int = 0
    max_points: int = 0
    max_wait: float = 0.0  # seconds from when its first request came
    preferred_balls: tuple[int, ...] = ()

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """What the operator asks for."""
        if not settings.batching:
            return cls()
        return cls(
            settings.max_batch_balls,
            settings.max_batch_points,
            settings.max_batch_wait_microseconds / 1e6,
            settings.preferred_batch_balls,
        )

    def choose(self, waiting: Sequence[Size]) -> Choice:
        """Choose from the front of those that wait.

        The first one is always taken, however large. A preferred size that some of them make up
        exactly does not wait; the largest such is taken.

        Args:
            waiting: At least one.
        """
        balls = points = taken = preferred = 0
        for size in waiting:
            balls, points = balls + size.balls, points + size.points
            if taken and (balls > self.max_balls or points > self.max_points):
                return Choice(preferred or taken, True)
            taken += 1
            if balls in self.preferred_balls:
                preferred = taken
        full = balls >= self.max_balls or points >= self.max_points
        return Choice(preferred or taken, full or preferred > 0)
