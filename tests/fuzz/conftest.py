"""Fuzzing: short in `make test`, long in `make fuzz` (--hypothesis-profile=fuzz)."""

import base64
import warnings
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import hypothesis
import numpy as np
from hypothesis import strategies as st
from tests.checks import bounded_memory
from tests.cloud_files import npy, npz, pcd, ply, point_cloud2, xyz

given = hypothesis.given  # `make fuzz` sets the profile with many examples

POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3)).astype(np.float32)

# What readers trip over: counts that promise much, signs, and numbers that are none.
WORDS = [
    b"0", b"-1", b"1", b"nan", b"inf", b"1e999", b"4294967295", b"999999999999999999",
    b"9223372036854775808", b"\x00", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\n", b"\r\n", b" ",
    b"#", b"x", b"end_header\n", b"element vertex 1000000000\n", b"property list uchar int x\n",
    b"POINTS 1000000000\n", b"WIDTH 0\n", b"HEIGHT 7\n", b"DATA binary_compressed\n", b"ascii",
    b"(0, 3)", b"(-1, 3)", b"(99999999999, 3)", b"'|O'", b"'<f8'", b"True", b"PK\x03\x04",
    "\u0663".encode(), b"_", b"1" * 400, b"x" * 5000,
]  # fmt: skip


FILES: dict[str, list[bytes]] = {
    "npy": [
        npy(POINTS), npy(POINTS.astype(">f8")), npy(np.asfortranarray(POINTS)),
        npy(POINTS.reshape(5, 8, 3)), npy(np.zeros((0, 3))), npy(np.zeros(3, "i4,f8")),
    ],
    "npz": [
        npz(False, points=POINTS), npz(points=POINTS, normals=POINTS),
        npz(points=POINTS, segment_ids=np.arange(40), colors=POINTS),
    ],
    "ply": [ply(POINTS, kind) for kind in ("ascii", "binary_little_endian", "binary_big_endian")],
    "pcd": [
        *(pcd(POINTS, kind) for kind in ("ascii", "binary", "binary_compressed")),
        pcd(POINTS, height=4),
    ],
    "xyz": [xyz(POINTS), b"# c\n0 0 0\n"],
}  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn, originals: list[bytes]) -> bytes:
    """A good file with a few bytes changed, put in, cut out, doubled or exchanged for words."""
    data = bytearray(draw(st.sampled_from(originals)))
    for _ in range(draw(st.integers(1, 4))):
        # Half of the changes go into the first 200 bytes, where headers are.
        end = min(len(data), 200) if draw(st.booleans()) else len(data)
        start = draw(st.integers(0, end))
        stop = min(len(data), start + draw(st.integers(0, 30)))
        match draw(st.integers(0, 4)):
            case 0:
                data[start:stop] = draw(st.sampled_from(WORDS))
            case 1:
                data[start:stop] = draw(st.binary(max_size=12))
            case 2:
                del data[start:]
            case 3:
                data[start:start] = data[start:stop]
            case _ if start < len(data):
                data[start] = draw(st.integers(0, 255))
    return bytes(data)


NUMBERS = st.one_of(
    st.integers(-3, 300),
    st.sampled_from([2**31, 2**53, 2**63, 2**64, 10**400, -(2**63), 0.1, 1e308, -0.0, 1e-320]),
    st.floats(width=32),
)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    NUMBERS,
    st.text(max_size=5),
    st.sampled_from(["x", "z", "\ud800", "x" * 5000]),
)
VALUES: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=4) | st.just("\ud800"), inner, max_size=3)
    ),
    max_leaves=12,
)
LISTS = st.one_of(
    VALUES,
    st.lists(st.lists(NUMBERS | st.none(), min_size=3, max_size=3), min_size=1, max_size=40),
    st.lists(
        st.lists(st.lists(NUMBERS | st.none(), min_size=3, max_size=3), min_size=2, max_size=2),
        min_size=1,
        max_size=4,
    ),
)


@st.composite
def changed(draw: st.DrawFn, good: dict[str, Any]) -> dict[str, Any]:
    """An object with some of its fields, at any depth, taken out or put to other values."""
    found = deepcopy(good)
    for _ in range(draw(st.integers(1, 3))):
        at: Any = found
        while True:
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(at[key], dict | list) and at[key] and draw(st.integers(0, 3)):
                at = at[key]
                continue
            if isinstance(at, dict) and not draw(st.integers(0, 4)):
                del at[key]
            else:
                at[key] = draw(VALUES | st.binary(max_size=8))
            break
    return found


def base64_of(value: Any) -> str:
    return base64.b64encode(value).decode()


DEPTH_IMAGE = {
    "depth": {
        "height": 5, "width": 8, "encoding": "32FC1",
        "data": np.linspace(0.4, 0.5, 40, dtype="<f4").tobytes(),
    },
    "intrinsics": {"fx": 20.0, "fy": 20.0, "cx": 3.5, "cy": 2.0},
    "T_cloud_camera": np.eye(4).tolist(),
}  # fmt: skip
DEPTH_ROWS = DEPTH_IMAGE | {"depth": np.full((5, 8), 0.4).tolist()}
POINT_CLOUD2 = point_cloud2(POINTS)


def decodes_or_refuses(work: Callable[[], object], size: int, max_points: int) -> None:
    """Run a decoder on `size` bytes; anything but an answer or an error of the table fails."""
    from tests.service.worker.conftest import check_problem

    from edgegrasp_model.errors import EdgeGraspError
    from edgegrasp_service.errors import report

    # Text costs most: a list and an object for each word; files unpack to five arrays at most.
    allowed = 200 * size + 5 * (48 * max_points + 65536) + 2**20
    with bounded_memory(allowed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            work()
        except EdgeGraspError as error:
            check_problem(report(error))
