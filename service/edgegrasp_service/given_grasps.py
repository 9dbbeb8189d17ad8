"""Edges and hand poses that a caller wants scored."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import MAX_CANDIDATES

Array = NDArray[Any]


@dataclass(frozen=True)
class GivenGrasps:
    """What to score: exactly one of the two."""

    edges: Array | None = None  # (M, 2) approach and contact points, rows of the cloud as sent
    hand_poses: Array | None = None  # (M, 4, 4) T_cloud_hand, metres

    def check(self) -> None:
        """Raise InvalidRequest unless there is one of the two, in its shape."""
        if self.edges is None and self.hand_poses is None:
            raise InvalidRequest("edges", "nothing", "Send edges or hand_poses.")
        if self.edges is not None and self.hand_poses is not None:
            raise InvalidRequest("hand_poses", "poses beside edges", "Send one of the two.")
        if self.edges is not None:
            shape: tuple[int, ...] = (2,)
            kinds, fix = "iu", "Send pairs of rows: [approach, contact]."
            field, array = "edges", self.edges
        else:
            assert self.hand_poses is not None
            shape = (4, 4)
            kinds, fix = "iuf", "Send 4 x 4 matrices T_cloud_hand, row-major."
            field, array = "hand_poses", self.hand_poses
        if array.shape[1:] != shape or not len(array) >= 1:
            raise InvalidRequest(field, f"shape {array.shape}", fix)
        if array.dtype.kind not in kinds:
            raise InvalidRequest(field, f"dtype {array.dtype}", fix)
        if len(array) > MAX_CANDIDATES:
            raise InvalidRequest(field, f"{len(array)} rows", f"Send at most {MAX_CANDIDATES}.")
        if kinds == "iuf" and not np.isfinite(array).all():
            row = int(np.argmin(np.isfinite(array).all(axis=(1, 2))))
            raise InvalidRequest(field, f"NaN or infinity in row {row}", "Send finite numbers.")
