from pathlib import Path

import numpy as np
import pytest

from edgegrasp_cli.planners.validate import (
    FUSED_VOXEL,
    Share,
    densities,
    own_successes,
    reference_successes,
)
from edgegrasp_sim.objects import ObjectSet, SceneKind
from edgegrasp_sim.simulation import ClutterSimulation


def test_every_candidate_of_a_labelled_view_counts_alike(tmp_path: Path) -> None:
    (tmp_path / "bootstrap_dataset").mkdir()
    # Two of eight are the teacher's best: both held; of the six others two were tried, one held.
    for name, held in (("packed_1_0", 1), ("packed_1_1", 0)):
        np.savez(
            tmp_path / "bootstrap_dataset" / f"{name}.npz",
            teacher_logit=np.arange(8, dtype=np.float16),
            success=np.array([0, held, -1, -1, -1, -1, 1, 1], dtype=np.int8),
        )
    share = reference_successes(tmp_path, SceneKind.PACKED)
    assert share.mean == pytest.approx((0.25 + 0.75 / 2 + 0.25) / 2)
    assert share.views == 2
    with pytest.raises(FileNotFoundError, match=r"pile_\*\.npz"):
        reference_successes(tmp_path, SceneKind.PILE)


def test_only_resampled_surfaces_are_equally_dense() -> None:
    def cloud(voxel: float) -> list[float]:
        with ClutterSimulation() as simulation:
            simulation.reset(SceneKind.PACKED, np.random.default_rng(0), 3)
            streams = np.random.default_rng(1), np.random.default_rng(2)
            seen = simulation.observe(*streams, surface_voxel=voxel)
        return densities([(seen.cloud, seen.camera_position)])

    pixels, resampled = cloud(0.0), cloud(FUSED_VOXEL)
    assert pixels[-1] > 2 * pixels[1]
    assert max(resampled[1:]) < 1.6 * min(resampled[1:])


def test_random_candidates_hold_now_and_then() -> None:
    share = own_successes(ObjectSet.builtin(SceneKind.PACKED), SceneKind.PACKED, 2)
    assert isinstance(share, Share)
    assert 0.0 < share.mean < 1.0
    assert "views" in str(share)
