"""Train the `scene` network on the labelled images of `scene_images`."""

import json
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save
from scipy.optimize import minimize
from torch import Tensor
from torch.nn import functional
from torch.optim import swa_utils

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_camera.depth import Intrinsics, metres, unproject
from edgegrasp_model.scene.network import VOTE_UNIT, SceneNet, SceneOutput, scene_features
from edgegrasp_model.scene.segment import group_pixels, run_network
from edgegrasp_training.scene_images import DEPTH_UNIT, SceneImage
from edgegrasp_training.scene_layouts import OBJECT

UP_SHARE = 0.5  # share of the images for which the network gets `up`
UP_ERROR = 0.02  # radians, standard deviation of the error of the given `up`
BATCH = 16
SIZES, SIZE_SHARES = ((352, 480), (256, 384), (192, 288)), (0.5, 0.3, 0.2)  # pixels, of batches
CLOSER_SHARE = 0.5  # share of the smaller images that are a cutout of a stored image
CROPPED_SHARE = 0.12  # share of the images cropped to the objects' surroundings
HELD_OUT = 2  # number of files, the first ones, that are not used for training
EVALUATED = 200  # approximate number of their images that are evaluated
WARM_UP = 200  # steps
SAVE_EVERY = 300  # seconds
AVERAGED = 0.998  # share of the old mean weights kept at each step
LINK_WEIGHT, UP_WEIGHT, NEAR_WEIGHT = 0.5, 0.5, 0.3  # in the loss
NEAR = 4  # output pixels around an object in which classes get extra weight
APART = 4.0  # weight of a link between different objects


class SceneBatch(NamedTuple):
    """Images and training targets, at the output's resolution."""

    features: Tensor  # (B, CHANNELS, H, W)
    classes: Tensor  # (B, H/2, W/2) int64; -1 without a reading
    votes: Tensor  # (B, 3, H/2, W/2) metres
    weight: Tensor  # (B, H/2, W/2) of each pixel's vote, lower in large objects
    links: Tensor  # (B, 2, H/2, W/2) to the next pixel: 1 same object, 0 not, -1 not judged
    up: Tensor  # (B, 3) unit


def read_images(files: Iterable[Path]) -> list[SceneImage]:
    """All images in files written by `generate`."""
    images = []
    for path in files:
        with np.load(path) as stored:
            columns = [stored[name] for name in SceneImage._fields]
        images += [SceneImage(*row) for row in zip(*columns, strict=True)]
    return images


def image_points(image: SceneImage) -> Float32:
    """The points (H, W, 3) of an image, camera frame, metres; NaN where there is no reading."""
    return unproject(metres(image.depth, DEPTH_UNIT), Intrinsics(*image.camera.tolist()))


def make_batch(
    images: Sequence[SceneImage], rng: np.random.Generator, up_known: bool | None = None
) -> SceneBatch:
    """Features and targets of images of one size; `up_known` None: random, with augmentation."""
    size = SIZES[0] if up_known is not None else SIZES[int(rng.choice(len(SIZES), p=SIZE_SHARES))]
    rows = [_example(image, rng, up_known, size) for image in images]
    return SceneBatch(*(torch.from_numpy(np.stack(each)) for each in zip(*rows, strict=True)))


def _example(
    image: SceneImage, rng: np.random.Generator, up_known: bool | None, size: tuple[int, int]
) -> tuple[NDArray[np.generic], ...]:
    points, label = image_points(image), image.label.astype(np.int64)
    centre, true_up = image.centre, image.up.astype(np.float64)
    full, closer = label.shape, up_known is None and rng.random() < CLOSER_SHARE
    step = 1.0 if closer else full[1] / size[1]
    corner = [int(rng.integers(full[d] - size[d] + 1)) if closer else 0 for d in (0, 1)]
    row, column = (corner[d] + ((np.arange(size[d]) + 0.5) * step).astype(np.int64) for d in (0, 1))
    points, label = points[row][:, column], label[row][:, column]
    if up_known is None and rng.random() < CROPPED_SHARE:
        points = _cropped(points, label, image.plane, rng)
    for turn, flip in ((_MIRROR, np.s_[:, ::-1]), (_HALF_TURN, np.s_[::-1, ::-1])):
        if up_known is None and rng.random() < 0.5:
            points, label = points[flip] * turn, label[flip]
            centre, true_up = centre * turn, true_up * turn
    up = true_up if up_known is not None else true_up + rng.normal(0.0, UP_ERROR, 3)
    known = rng.random() < UP_SHARE if up_known is None else up_known
    footprint = step / float(image.camera[0])
    features = scene_features(points, up / np.linalg.norm(up) if known else None, footprint)
    points, label = points[::2, ::2], label[::2, ::2]
    seen = ~np.isnan(points[..., 2])
    number = np.where(seen & (label >= OBJECT), label - OBJECT, -1)
    classes = np.where(seen, np.minimum(label, OBJECT), -1)
    votes = np.where((number >= 0)[..., None], centre[np.maximum(number, 0)] - points, 0.0)
    count = np.bincount(number[number >= 0], minlength=1)
    weight = np.where(number >= 0, 1.0 / np.sqrt(count[np.maximum(number, 0)] + 20.0), 0.0)
    links = np.full((2, *number.shape), -1, dtype=np.int64)
    for link, objects, read in ((links[0].T, number.T, seen.T), (links[1], number, seen)):
        link[:-1] = np.where((objects[:-1] >= 0) & read[1:], objects[:-1] == objects[1:], -1)
    numbers = votes.transpose(2, 0, 1), weight, links, true_up
    return features, classes, *(each.astype(np.float32) for each in numbers)


_MIRROR, _HALF_TURN = np.array([[-1, 1, 1], [-1, -1, 1]], dtype=np.float32)


def _cropped(points: Float32, label: Int64, plane: Float32, rng: np.random.Generator) -> Float32:
    """Keep only points above the support and near objects, like a cropped cloud."""
    objects = points[(label >= OBJECT) & ~np.isnan(points[..., 2])]
    if len(objects) < 50:
        return points
    height = points @ plane[:3] - plane[3]
    away = points - np.median(objects, axis=0)
    away -= (away @ plane[:3])[..., None] * plane[:3]
    distance = np.linalg.norm(away, axis=-1)
    kept = (height > rng.uniform(-0.03, 0.012)) & (distance < rng.uniform(0.12, 0.5))
    return np.where(kept[..., None], points, np.float32(np.nan))


def scene_loss(output: SceneOutput, batch: SceneBatch) -> dict[str, Tensor]:
    """The weighted parts of the loss."""
    wrong = functional.cross_entropy(
        output.classes, batch.classes, ignore_index=-1, reduction="none"
    )
    seen = batch.classes >= 0
    near = functional.max_pool2d(batch.weight, 2 * NEAR + 1, 1, NEAR) * seen
    error = functional.smooth_l1_loss(
        output.votes / VOTE_UNIT, batch.votes / VOTE_UNIT, reduction="none", beta=0.2
    )
    votes = (error.sum(dim=1) * batch.weight).sum() / batch.weight.sum().clamp(min=1e-6)
    judged = (batch.links >= 0).float()
    weight = judged * torch.where(batch.links == 0, APART, 1.0)
    apart = functional.binary_cross_entropy_with_logits(
        output.links, batch.links.clamp(min=0), reduction="none"
    )
    links = (apart * weight).sum() / weight.sum().clamp(min=1.0)
    agree = functional.cosine_similarity(output.up, batch.up[..., None, None], dim=1)
    up = ((1.0 - agree) * seen).sum() / seen.sum().clamp(min=1)
    return {
        "classes": wrong.sum() / seen.sum().clamp(min=1),
        "near": NEAR_WEIGHT * (wrong * near).sum() / near.sum().clamp(min=1e-6),
        "votes": votes,
        "links": LINK_WEIGHT * links,
        "up": UP_WEIGHT * up,
    }


def evaluate(network: SceneNet, images: Sequence[SceneImage]) -> dict[str, float]:
    """Losses and the intersection over union of each class; half of the images have `up`."""
    network.eval()
    rng, totals = np.random.default_rng(0), np.zeros((3, 3))
    losses: dict[str, float] = {}
    some = images[:: max(len(images) // EVALUATED, 1)]
    with torch.inference_mode():
        for number, image in enumerate(some):
            batch = make_batch([image], rng, up_known=number % 2 == 0)
            output = network(batch.features)
            for name, value in scene_loss(output, batch).items():
                losses[name] = losses.get(name, 0.0) + float(value) / len(some)
            said, true = output.classes.argmax(1).numpy(), batch.classes.numpy()
            np.add.at(totals, (true[true >= 0], said[true >= 0]), 1)
    both = np.diag(totals)
    shares = both / (totals.sum(0) + totals.sum(1) - both)
    return losses | dict(zip(("iou_other", "iou_support", "iou_object"), shares, strict=True))


def fit_confidence(network: SceneNet, images: Sequence[SceneImage]) -> list[float]:
    """Logistic regression from an instance's mean probability to whether it is mostly an object."""
    means, right = [], []
    for row, image in enumerate(images):
        known = image.up.astype(np.float64) if row % 2 else None
        points, footprint = image_points(image), 1.0 / float(image.camera[0])
        features = scene_features(points, known, footprint)
        pixels, _ = run_network(network, features, points, footprint)
        number, mean = group_pixels(pixels)
        size = np.bincount(number[number >= 0])
        on_object = (number >= 0) & (image.label[::2, ::2] >= OBJECT)
        means.append(mean)
        right.append(np.bincount(number[on_object], minlength=len(size)) >= 0.5 * size)
    sign, mean = np.where(np.concatenate(right), 1.0, -1.0), np.concatenate(means)

    def loss(weights: Float64) -> float:
        score = weights[0] + weights[1] * mean
        return float(np.logaddexp(0.0, -sign * score).sum() / max(len(sign), 1))

    fitted: list[float] = minimize(loss, np.zeros(2)).x.round(3).tolist()
    return fitted


def batches(data: Path, images: list[SceneImage], rng: np.random.Generator) -> Iterator[SceneBatch]:
    """Endless batches from the folder's files, prepared ahead; files added later are read too.

    All images read are appended to `images`.
    """
    read: set[Path] = set()
    orders, draws = rng.spawn(2)  # the latter is used in another thread
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        while True:
            new = [path for path in _files(data)[HELD_OUT:] if path not in read]
            read.update(new)
            images += read_images(new)
            if len(images) < BATCH:
                value = f"{data} with {len(images)} images and {HELD_OUT} files held out"
                raise ValueError(f"data: got {value}. Make more with edgegrasp generate-scenes.")
            order = orders.permutation(len(images))
            for start in range(0, len(order) - BATCH + 1, BATCH):
                chosen = [images[k] for k in order[start : start + BATCH].tolist()]
                following = pool.submit(make_batch, chosen, draws)
                if waiting is not None:
                    yield waiting.result()
                waiting = following


def train(
    data: Path,  # folder of `scenes-*.npz`
    run: Path,  # gets checkpoints and `log.txt`
    seconds: float,
    seed: int = 0,  # of weights and batches
    start: Path | None = None,  # a checkpoint to continue from
    threads: int = 1,  # of the processor
    rate: float = 3e-3,  # the highest learning rate
) -> None:
    """Train for a given time; `run/scene.safetensors` gets the mean weights every few minutes."""
    torch.manual_seed(seed)
    torch.set_num_threads(threads)
    run.mkdir(parents=True, exist_ok=True)
    network = SceneNet()
    if start is not None:
        network.load_state_dict(load_file(start))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaging = swa_utils.get_ema_multi_avg_fn(AVERAGED)  # type: ignore[no-untyped-call]
    mean = swa_utils.AveragedModel(network, multi_avg_fn=averaging, use_buffers=True)
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=0.01)
    held, images = read_images(_files(data)[:HELD_OUT]), list[SceneImage]()
    source = batches(data, images, np.random.default_rng(seed))
    begin = saved = time.monotonic()
    step, running = 0, dict[str, float]()
    while (spent := time.monotonic() - begin) < seconds:
        factor = min(1.0, (step + 1) / WARM_UP) * 0.5 * (1 + math.cos(math.pi * spent / seconds))
        for parameters in optimiser.param_groups:
            parameters["lr"] = rate * max(factor, 1e-3)
        for name, value in _learn(network, optimiser, next(source)).items():
            running[name] = 0.98 * running.get(name, value) + 0.02 * value
        mean.update_parameters(network)
        step += 1
        now = time.monotonic()
        if now - saved > SAVE_EVERY or now - begin >= seconds:
            saved = now
            averaged = mean.module
            assert isinstance(averaged, SceneNet)
            losses = f"train {_text(running)} held {_text(evaluate(averaged, held))}"
            weights = {name: value.contiguous() for name, value in averaged.state_dict().items()}
            partial = run / "scene.partial"
            confidence = json.dumps(fit_confidence(averaged, held))
            partial.write_bytes(save(weights, {"confidence": confidence}))
            partial.replace(run / "scene.safetensors")
            with (run / "log.txt").open("a") as log:
                log.write(f"{step} {now - begin:.0f}s images {len(images)} {losses}\n")


def _files(data: Path) -> list[Path]:
    return sorted(data.glob("scenes-????.npz"))


def _learn(
    network: SceneNet, optimiser: torch.optim.Optimizer, batch: SceneBatch
) -> dict[str, float]:
    network.train()
    # Products in bfloat16 are about three times as fast on processors that support it.
    with torch.autocast("cpu", torch.bfloat16):
        output = network(batch.features.contiguous(memory_format=torch.channels_last))
    parts = scene_loss(output, batch)
    optimiser.zero_grad(set_to_none=True)
    torch.stack(list(parts.values())).sum().backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
    optimiser.step()
    return {name: value.item() for name, value in parts.items()}


def _text(values: dict[str, float]) -> str:
    return " ".join(f"{name} {value:.3f}" for name, value in values.items())
