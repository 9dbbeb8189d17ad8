import base64
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_service.point_cloud2 import TYPES, read_point_cloud2

MANY = 10_000
CODES = {kind: code for code, kind in TYPES.items()}


def layout(rows: np.ndarray, padding: int = 0, big: bool = False) -> dict[str, Any]:
    """A structured array (H, W) as a PointCloud2, with bytes after every row of points."""
    record = rows.dtype.newbyteorder(">" if big else "<")
    data = b"".join(row.astype(record).tobytes() + bytes(padding) for row in rows)
    fields = [
        {
            "name": name,
            "offset": int(record.fields[name][1]),
            "datatype": CODES[rows.dtype[name].base.str[1:]],
            "count": int(np.prod(rows.dtype[name].shape, dtype=int)),
        }
        for name in record.names
    ]
    height, width = rows.shape
    step = record.itemsize
    return {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": big,
        "point_step": step,
        "row_step": width * step + padding,
        "data": data,
    }


def cloud_of(shape: tuple[int, int], kind: str = "f4", extra: tuple[Any, ...] = ()) -> np.ndarray:
    names = [("x", kind), ("intensity", "u2"), ("y", kind), ("z", kind), ("ring", "u1", 3), *extra]
    rows = np.zeros(shape, np.dtype(names, align=True))
    random = np.random.default_rng(0)
    for name in rows.dtype.names:
        if rows.dtype[name].kind == "f":
            rows[name] = random.normal(size=shape)
    return rows


def xyz(rows: np.ndarray, names: tuple[str, ...] = ("x", "y", "z")) -> np.ndarray:
    return np.stack([rows[name] for name in names], axis=-1)


@settings(deadline=None)
@given(
    height=st.integers(1, 5),
    width=st.integers(1, 7),
    padding=st.integers(0, 9),
    big=st.booleans(),
    kind=st.sampled_from(["f4", "f8"]),
    text=st.booleans(),
)
def test_every_layout_gives_the_points(
    height: int, width: int, padding: int, big: bool, kind: str, text: bool
) -> None:
    rows = cloud_of((height, width), kind)
    fields = layout(rows, padding, big)
    if text:
        fields["data"] = base64.b64encode(fields["data"]).decode()
    cloud = read_point_cloud2(fields, MANY)
    expected = xyz(rows) if height > 1 else xyz(rows)[0]
    np.testing.assert_array_equal(cloud.points, expected)
    assert cloud.points.dtype == np.dtype(kind)
    assert cloud.normals is cloud.colors is None


@pytest.mark.parametrize("kind", ["f4", "u4"])
def test_normals_and_colours(kind: str) -> None:
    names = ("normal_x", "normal_y", "normal_z")
    rows = cloud_of((3, 4), extra=(*((name, "f4") for name in names), ("rgb", kind)))
    packed = np.arange(12, dtype=np.uint32).reshape(3, 4) + 0x112200
    rows["rgb"] = packed.view(kind)
    for big in (False, True):
        cloud = read_point_cloud2(layout(rows, big=big), MANY)
        np.testing.assert_array_equal(cloud.normals, xyz(rows, names))
        np.testing.assert_array_equal(cloud.colors[0, 2], [0x11, 0x22, 0x02])


def test_no_points() -> None:
    assert read_point_cloud2(layout(cloud_of((1, 0))), MANY).points.shape == (0, 3)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"data": "no base64!"}, "point_cloud2.data"),
        ({"data": None}, "point_cloud2.data"),
        ({"dense": True}, "point_cloud2.dense"),
        ({"fields": []}, "point_cloud2.fields"),
        ({"width": 2**31}, "point_cloud2.width"),
        ({"row_step": 2**30, "height": 1000}, "point_cloud2.data"),
        ({"point_step": 0}, "point_cloud2.fields.0.offset"),
    ],
)
def test_bad_layouts(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        read_point_cloud2(layout(cloud_of((1, 4))) | changes, MANY)
    assert caught.value.field == field
    assert caught.value.fix


@pytest.mark.parametrize("value", [None, 3, [], "text"])
def test_what_is_no_layout(value: object) -> None:
    with pytest.raises(InvalidRequest) as caught:
        read_point_cloud2(value, MANY)
    assert caught.value.field.startswith("point_cloud2")
