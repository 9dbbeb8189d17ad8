"""Weights recalibrated on outcomes: their scores are what the outcomes say, their order stays."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from edgegrasp_model.detector import WEIGHTS_FOLDER, GraspDetector
from edgegrasp_model.networks.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgegrasp_model.networks.config import CheckpointMetadata
from edgegrasp_model.options import DetectOptions
from edgegrasp_training.examples import pack_balls, pack_hands, tried_grasps
from edgegrasp_training.outcomes import fit, read_outcomes, recalibrate


@pytest.mark.parametrize("name", ["balls", "vn", "hands"])
def test_the_new_weights_answer_the_fitted_probability(name, networks, made_up_view, tmp_path):
    config, old = networks[name], tmp_path / "old.safetensors"
    metadata = CheckpointMetadata("old", config, 0.0045, "panda", temperature=1.5)
    network = build_network(config, torch.Generator().manual_seed(0))
    save_checkpoint(old, network, metadata)
    network, metadata = load_checkpoint(old)
    lines = [
        {"digest": metadata.digest, "score": 0.9, "held": number % 3 == 0} for number in range(60)
    ]
    lines.append({"digest": "of other weights", "score": 0.9, "held": True})
    file = tmp_path / "outcomes.jsonl"
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert recalibrate(old, file, tmp_path).startswith("60 outcomes, 0.33 held")
    new, recalibrated = load_checkpoint(tmp_path / "old-robot.safetensors")
    assert recalibrated.training["recalibrated_from_digest"] == metadata.digest
    scale, shift = fit(read_outcomes(file, metadata.digest))
    assert shift < -0.5
    grasps = tried_grasps(made_up_view(1), config)
    pack = pack_hands if name == "hands" else pack_balls
    batch = pack(grasps, grasps.balls(), config).batch
    with torch.inference_mode():
        before, after = network(batch), new(batch)
    expected = scale * before / metadata.temperature + shift
    torch.testing.assert_close(after / recalibrated.temperature, expected, atol=1e-4, rtol=1e-4)


def test_the_order_of_grasps_stays_and_few_outcomes_warn(tmp_path: Path) -> None:
    (old,) = (one for one in WEIGHTS_FOLDER.glob("edgegrasp-plus.safetensors"))
    before = GraspDetector.load(old)
    lines = [{"digest": before.metadata.digest, "score": 0.9, "held": row == 0} for row in range(9)]
    file = tmp_path / "outcomes.jsonl"
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert "Warning: fewer than 25 outcomes" in recalibrate(old, file, tmp_path)
    after = GraspDetector.load(tmp_path / "edgegrasp-plus-robot.safetensors")
    box = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * (0.02, 0.03, 0.05)
    boxes = np.concatenate([box, box @ np.diag([1, 0.6, 1]) + (0.15, 0, 0)])
    alone = {"support": None, "objects": "off", "order": "highest", "min_score": 0.0}
    options = DetectOptions(viewpoint=(0.0, -0.3, 0.5), **alone)
    for asked in (options, options.model_copy(update={"order": "score"})):
        first, second = (one.detect(boxes, asked).grasps for one in (before, after))
        assert len(first) > 5
        for one, other in zip(first, second, strict=True):
            np.testing.assert_array_equal(one.T_cloud_hand, other.T_cloud_hand)
        assert second[0].score < first[0].score - 0.1
