"""The library in a program that configures PyTorch and NumPy, and uses threads and processes."""

import os
import pickle
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from threading import Event

import numpy as np
import pytest
import torch
from tests.programs import run

from edgegrasp_camera.depth import metres
from edgegrasp_model.errors import InvalidRequest, UnknownModel
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.ranking import SIMILAR_DISTANCE, densest_first
from edgegrasp_model.scene.cloud import check_cloud
from edgegrasp_model.scene.segment import load_scene_network, one_thread

from .rendered import boxes_on_table, camera, render, table

IMAGE = render([table(), *boxes_on_table(1)], camera(0.7, 0.0, 0.9))
OPTIONS = DetectOptions.model_validate({"viewpoint": (0, 0, 0), "num_approach_points": 8})


@contextmanager
def float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("model", ["edgegrasp-plus", "vn-edgegrasp"])
def test_defaults_of_the_host_program_change_no_answer(catalogue, model: str) -> None:
    detect = partial(catalogue.get(model).detect, IMAGE, OPTIONS)
    expected = [grasp.score for grasp in detect().grasps]
    assert expected
    autocast = torch.autocast("cpu", torch.bfloat16)
    for host in (torch.device("meta"), float64(), autocast, np.errstate(all="raise")):
        load_scene_network.cache_clear()
        with host:
            assert [grasp.score for grasp in detect().grasps] == expected
    catalogue.warm_up()


def test_good_hands_far_apart_raise_no_underflow() -> None:
    poses = np.stack([np.eye(4)] * 2)
    poses[1, 0, 3] = 38.2 * SIMILAR_DISTANCE
    with np.errstate(all="raise"):
        assert densest_first(np.arange(2), np.array([0.9, 0.8]), poses).tolist() == [0, 1]


def test_detections_in_threads_leave_the_number_of_threads_as_it_was() -> None:
    threads, inside, alone = torch.get_num_threads(), Event(), Event()

    def other() -> None:
        with one_thread():
            inside.set()
            alone.wait(60)

    torch.set_num_threads(2)
    with ThreadPoolExecutor() as pool:
        with one_thread():
            running = pool.submit(other)
            inside.wait(0.3)
        alone.set()
        running.result()
    with ThreadPoolExecutor() as pool:
        seen = pool.submit(torch.get_num_threads).result()
    torch.set_num_threads(threads)
    assert seen == 2


@pytest.mark.parametrize("error", [InvalidRequest("cloud", "x", "Fix."), UnknownModel("a", "b")])
def test_errors_pass_between_processes(error: InvalidRequest) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.field) == (type(error), str(error), error.field)


def test_masked_readings_are_none() -> None:
    left = np.broadcast_to(IMAGE[..., :1] < 0.0, IMAGE.shape)
    masked, holes = np.ma.array(IMAGE, mask=left), np.where(left, np.nan, IMAGE)
    assert np.array_equal(np.asarray(check_cloud(masked).points), check_cloud(holes).points)
    depths = np.asarray(metres(masked[..., 2]))
    assert np.array_equal(depths, metres(holes[..., 2]), equal_nan=True)


def test_detects_where_onednn_is_limited_to_avx2() -> None:
    limited = os.environ | {"ONEDNN_MAX_CPU_ISA": "AVX2"}
    program = "from edgegrasp_model.detector import ModelCatalogue as C; C.load().warm_up()"
    run(sys.executable, "-c", program, env=limited)
