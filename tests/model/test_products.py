"""Products in inference: the same whatever the library, and whatever other rows there are."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from edgegrasp_model import products
from edgegrasp_model.networks.balls import BallBatch
from edgegrasp_model.networks.checkpoint import build_network
from edgegrasp_model.networks.config import EDGEGRASP_SMALL
from edgegrasp_model.networks.layers import (
    BallMaximum,
    PackedLinear,
    PackedMlp,
    ball_chunks,
    by_chunks,
    in_chunks,
)

pytestmark = pytest.mark.skipif(
    not hasattr(torch.ops.mkldnn, "_reorder_linear_weight"), reason="PyTorch has no oneDNN here"
)
LIBRARIES = pytest.mark.parametrize("onednn", [False, True], ids=["mkl", "onednn"])


def random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def choose(monkeypatch: pytest.MonkeyPatch, onednn: bool) -> None:
    monkeypatch.setattr(products, "onednn_is_faster", lambda: onednn)


@LIBRARIES
@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize("outputs", [1, 24])
def test_a_product_is_the_linear_layer(monkeypatch, onednn, rectified, outputs):
    choose(monkeypatch, onednn)
    weight, bias, values = random(1, outputs, 40), random(2, outputs), random(3, 70, 40)
    own = weight[:, 3:30]  # a part of a matrix, as shared layers have
    with torch.inference_mode():
        product = PackedLinear(own, bias, rectified=rectified)
        assert (product._packed is not None) == (onednn and outputs > 1)
        found = product(values[:, 3:30])
    expected = F.linear(values[:, 3:30], own, bias)
    torch.testing.assert_close(found, expected.relu() if rectified else expected)


def test_gradients_doubles_and_autocast_take_the_plain_product(monkeypatch):
    choose(monkeypatch, onednn=True)
    weight = random(1, 8, 8)
    assert PackedLinear(weight)._packed is None  # gradients are recorded
    with torch.no_grad():
        assert PackedLinear(weight)._packed is not None
        assert PackedLinear(weight.double())._packed is None
        assert PackedLinear(weight.to("meta"))._packed is None
        with torch.autocast("cpu", torch.bfloat16):
            assert PackedLinear(weight)._packed is None


@LIBRARIES
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("rows", [256, 512])
def test_a_row_is_the_same_wherever_it_is_in_a_piece(monkeypatch, onednn, threads, rows):
    choose(monkeypatch, onednn)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.inference_mode():
            for inputs, outputs in ((3, 32), (138, 512), (224, 256), (512, 1024)):
                product = PackedLinear(random(1, outputs, inputs), random(2, outputs))
                values = random(3, rows, inputs)
                whole = product(values)
                for shift in (1, 7, 100):
                    moved = product(torch.roll(values, shift, dims=0))
                    assert torch.equal(torch.roll(moved, -shift, dims=0), whole)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("gradients", [False, True])
def test_an_mlp_by_pieces_is_the_mlp(gradients):
    mlp = nn.Sequential(nn.Linear(6, 16), nn.ReLU(), nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 3))
    values = random(1, 75, 6)
    with torch.set_grad_enabled(gradients):
        found = by_chunks(PackedMlp(mlp), values, rows=32)
    torch.testing.assert_close(found, mlp(values))
    assert found.requires_grad == gradients


@pytest.mark.parametrize("rows", [3, 16, 1000])
def test_pieces_hold_every_row_and_the_maxima_are_those_of_the_balls(random_scene, rows):
    batch = BallBatch.concatenate([random_scene(seed).batch(torch.float32) for seed in (1, 2)])
    values = random(1, len(batch.points), 5)
    expected = torch.stack([ball.amax(0) for ball in torch.split(values, batch.ball_sizes)])
    with torch.no_grad():
        pieces, found = ball_chunks(values, batch, rows), BallMaximum(batch.num_balls)
        for piece in pieces:
            assert len(piece.values) == len(piece.ball_of_point) == sum(piece.sizes) == rows
            found.add(piece.values, piece)
        assert torch.equal(torch.cat([piece.values for piece in pieces])[: len(values)], values)
    assert torch.equal(found.result(), expected)


def test_only_inference_fills_pieces_up():
    values = random(1, 10, 2)
    assert [len(part) for (part,) in in_chunks(4, values)] == [4, 4, 2]
    with torch.no_grad():
        assert [len(part) for (part,) in in_chunks(4, values)] == [4, 4, 4]
        assert [len(part) for (part,) in in_chunks(4, values.to("meta"))] == [10]


def test_both_libraries_give_the_same_scores(random_scene, monkeypatch):
    network, batch = build_network(EDGEGRASP_SMALL), random_scene(1).batch(torch.float32)
    scores = []
    for onednn in (False, True):
        choose(monkeypatch, onednn)
        with torch.inference_mode():
            scores.append(network(batch).numpy())
    np.testing.assert_allclose(scores[1], scores[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("capability", "name", "expected"),
    [
        ("AVX512", "AMD EPYC", True),
        ("AVX2", "AMD Ryzen 5", False),
        ("AVX512", "Intel Xeon", False),
        ("DEFAULT", "", False),
    ],
)
def test_onednn_is_for_amd_with_avx512(monkeypatch, capability, name, expected):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(products, "_processor", lambda: name)
    products.onednn_is_faster.cache_clear()
    try:
        assert products.onednn_is_faster() == expected
    finally:
        products.onednn_is_faster.cache_clear()
