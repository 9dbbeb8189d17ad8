"""Fuzzing: short in `make test`, long in `make fuzz` (--hypothesis-profile=fuzz)."""

from copy import deepcopy
from typing import Any

import numpy as np
from hypothesis import strategies as st

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
