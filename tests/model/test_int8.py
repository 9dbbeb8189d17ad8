from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from edgegrasp_model import int8_layers
from edgegrasp_model.ball_batch import BallBatch
from edgegrasp_model.checkpoint import CheckpointMetadata, load_checkpoint, save_checkpoint
from edgegrasp_model.detector import GraspDetector
from edgegrasp_model.errors import InvalidCheckpoint
from edgegrasp_model.int8_layers import Int8Linear
from edgegrasp_model.int8_network import INT8, quantise
from edgegrasp_model.network import build_network
from edgegrasp_model.pieces import ball_pieces


@pytest.fixture(scope="module")
def batches(random_scene):
    return [random_scene(seed).batch(torch.float32) for seed in range(4)]


@pytest.fixture(scope="module")
def network(tiny_config):
    return build_network(tiny_config)


@pytest.fixture(scope="module")
def quantised(network, batches):
    return quantise(network, batches)


@pytest.fixture
def checkpoint(tmp_path, quantised):
    path = tmp_path / "tiny-int8.safetensors"
    metadata = CheckpointMetadata("tiny-int8", quantised.config, 0.0045, "panda")
    save_checkpoint(path, quantised, metadata)
    return path


def logits(network: torch.nn.Module, batch: BallBatch) -> np.ndarray:
    with torch.inference_mode():
        return network(batch).numpy()


def test_a_layer_is_that_of_its_bytes():
    layer, generator = Int8Linear(8, 4), torch.Generator().manual_seed(0)
    weight = torch.randn(4, 8, generator=generator)
    bias = torch.randn(4, generator=generator)
    values = torch.rand(6, 8, generator=generator) * 3 - 1
    layer.fill(weight, bias, largest=0.75)
    taken = layer.bytes_of(values)
    assert taken.dtype == torch.uint8
    dequantised = taken * layer.input_scale
    kept = values.clamp(0, 0.75 * 255 / 127)
    torch.testing.assert_close(dequantised, kept, rtol=0, atol=0.75 / 127 / 1.99)
    own_weight = layer.weight * layer.weight_scale[:, None]
    torch.testing.assert_close(own_weight, weight, rtol=0, atol=float(weight.abs().max()) / 250)
    expected = dequantised @ own_weight.T + bias
    torch.testing.assert_close(layer(taken), expected, rtol=1e-5, atol=1e-5)
    following = Int8Linear(4, 4)
    following.fill(torch.eye(4), None, largest=4.0)
    torch.testing.assert_close(layer(taken, following), following.bytes_of(expected))
    more = torch.ones(6, 4)
    torch.testing.assert_close(layer(taken, following, more), following.bytes_of(expected + 1))


def test_scores_are_those_of_float32_but_for_a_little(network, quantised, random_scene):
    for seed in range(10, 14):  # none of those that it was measured on
        batch = random_scene(seed).batch(torch.float32)
        own, of_bytes = logits(network, batch), logits(quantised, batch)
        assert np.corrcoef(own, of_bytes)[0, 1] > 0.99
        assert own[of_bytes.argmax()] >= own.max() - 0.1 * own.std()


def test_no_bit_of_a_score_depends_on_the_rest_of_a_batch(quantised, batches):
    together = logits(quantised, BallBatch.concatenate(batches))
    alone = np.concatenate([logits(quantised, batch) for batch in batches])
    np.testing.assert_array_equal(together, alone)


def test_balls_may_lie_across_pieces(quantised, batches, monkeypatch):
    expected = logits(quantised, batches[0])
    monkeypatch.setattr(int8_layers, "ball_pieces", partial(ball_pieces, rows=7))
    monkeypatch.setattr(int8_layers, "CONVOLVED", 5)
    np.testing.assert_array_equal(logits(quantised, batches[0]), expected)


def test_a_checkpoint_scores_as_what_was_saved(checkpoint, quantised, batches):
    network, metadata = load_checkpoint(checkpoint)
    assert metadata.network.architecture == INT8
    np.testing.assert_array_equal(logits(network, batches[0]), logits(quantised, batches[0]))


def test_weights_in_int8_stay_on_the_processor(checkpoint, box_on_table):
    detector = GraspDetector.load(checkpoint, device="cuda")
    assert detector.device == torch.device("cpu")
    assert detector.detect(box_on_table()).grasps


def test_there_must_be_onednn(checkpoint, monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    with pytest.raises(InvalidCheckpoint, match="oneDNN"):
        load_checkpoint(checkpoint)


def test_only_float32_edgegrasp_networks_on_some_balls(tiny_config, network, quantised, batches):
    other = build_network(replace(tiny_config, architecture="vn-edgegrasp"))
    with pytest.raises(ValueError, match=r"architecture: got 'vn-edgegrasp'"):
        quantise(other, batches)
    with pytest.raises(ValueError, match=r"architecture: got 'edgegrasp-int8'"):
        quantise(quantised, batches)
    with pytest.raises(ValueError, match="batches: got none"):
        quantise(network, [])
