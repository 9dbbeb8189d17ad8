import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.checks import bounded_memory, refusal
from tests.cloud_files import lzf_literals, npy, npz, pcd, ply, png, xyz

from edgegrasp_camera.files import read_file, read_png
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.request_cloud import decode_points
from edgegrasp_service.errors import PayloadTooLarge

POINTS = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
MANY = 1000
MIB = 2**20
NAMES_THE_END = b"comment none", b"comment end_header is below"

GOOD_FILES = {
    "npy": npy(POINTS),
    "npy, column order": npy(np.asfortranarray(POINTS)),
    "npy, big endian": npy(POINTS.astype(">f4")),
    "npz": npz(points=POINTS, colors=POINTS),
    "npz, one array": npz(anything=POINTS),
    "ply": ply(POINTS).replace(*NAMES_THE_END),
    "ply, big endian": ply(POINTS, "binary_big_endian"),
    "ply, text": ply(POINTS, "ascii").replace(*NAMES_THE_END),
    "pcd": pcd(POINTS),
    "pcd, text": pcd(POINTS, "ascii"),
    "pcd, compressed": pcd(POINTS, "binary_compressed"),
    "xyz": xyz(POINTS),
}


@pytest.mark.parametrize("name", GOOD_FILES)
def test_every_format_gives_the_same_points_and_no_more_than_allowed(name: str) -> None:
    points = read_file(name[:3], GOOD_FILES[name], MANY).points
    np.testing.assert_array_equal(np.asarray(points, dtype=np.float32), POINTS)
    assert points.dtype.isnative
    with refusal("cloud", "40 points", "39", PayloadTooLarge):
        read_file(name[:3], GOOD_FILES[name], max_points=39)


@pytest.mark.parametrize("name", [name for name in GOOD_FILES if name != "xyz"])
@settings(max_examples=30, derandomize=True, deadline=None)
@given(data=st.data())
def test_truncated_files_are_refused(name: str, data: st.DataObject) -> None:
    whole = GOOD_FILES[name]
    # Text may end inside its last number, and faces behind the vertices are not read.
    unread = {"ply": 14, "ply, big endian": 14, "ply, text": 30, "pcd, text": 12}.get(name, 1)
    needed = len(whole) - unread
    cut = data.draw(st.integers(0, needed))
    with refusal("cloud"):
        read_file(name[:3], whole[:cut], MANY)


def compressed_pcd(header: str, columns: bytes, packed: bytes | None = None) -> bytes:
    packed = lzf_literals(columns) if packed is None else packed
    sizes = struct.pack("<II", len(packed), len(columns))
    return header.encode("latin-1") + b"DATA binary_compressed\n" + sizes + packed


def test_a_compressed_pcd_with_a_second_header_in_its_comments() -> None:
    """A reader that took `\x85` as the end of a line returned the memory behind the buffer."""
    count = 853
    header = (
        "FIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 1 1 1\nTYPE F F F U U U\n"
        "#\x85FIELDS x y z\n#\x85SIZE 4 4 4\n#\x85TYPE F F F\n#\x85COUNT 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\n"
    )
    points = np.random.default_rng(0).normal(size=(3, count)).astype("<f4")
    cloud = read_file("pcd", compressed_pcd(header, points.tobytes() + b"\7" * (3 * count)), MANY)
    np.testing.assert_array_equal(cloud.points, points.T)
    np.testing.assert_array_equal(cloud.normals, np.full((count, 3), 7))
    with pytest.raises(InvalidRequest):
        read_file("pcd", compressed_pcd(header, points.tobytes()), MANY)


def npy_with(header: bytes, version: int) -> bytes:
    size = struct.pack("<H" if version == 1 else "<I", len(header))
    return b"\x93NUMPY" + bytes([version, 0]) + size + header


def npy_of(descr: str, shape: str, body: bytes = b"") -> bytes:
    """A file of what its header says, whatever that is."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n"
    return npy_with(header.encode(), 1) + body


def npz_packed_by(method: int, member: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("points.npy", member)
    return stream.getvalue().replace(b"\x5d\0\0\x80\0", b"\x5d\xff\xff\xff\xff")


DEEP = b"-" * 9900 + b"1"  # an expression
ENDED = b"end_header\n" + bytes(100)
TWO_POINTS = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n"
BAD_FILES = [  # and what is said of their value, and of what to send
    ("pcd", pcd(POINTS).replace(b"VIEWPOINT 0 0", b"VIEWPOINT 0 nan"), "", ""),
    ("npz", npz(a=POINTS, b=POINTS), "a, b", "points=points"),
    ("npz", npz(), "no array points", "points=points"),
    ("npz", npz_packed_by(zipfile.ZIP_LZMA, npy(POINTS)), "", "savez"),
    ("npz", npz_packed_by(zipfile.ZIP_BZIP2, npy(POINTS)), "", "savez"),
    ("npy", npy_with(DEEP, 1), "", "writes"),
    ("npy", npy_with(DEEP, 2), "", "writes"),
    *(
        ("npy", npy_of(descr, shape, bytes(12)), "", "")
        for descr, shape in (
            ("'<f4'", "(True, 3)"),
            ("'<f4'", "(-1, 3)"),
            ("'<f4'", "(99999999999999999999999999, 0, 3)"),
            ("'<f4'", "(1" + ", 1" * 99 + ")"),
            ("('<f4',(3,))", "(1,)"),
            ("'|O'", "(1, 3)"),
            ("'|V0'", "(1, 3)"),
        )
    ),
    *(
        ("ply", b"ply\nformat binary_little_endian 1.0\n" + header + ENDED, "", "vertices")
        for header in (
            b"element face 3\nproperty float x\n",
            b"element vertex -3\nproperty float x\nproperty float y\nproperty float z\n",
            b"element vertex 1\nproperty float x\nproperty float y\n",
            b"element vertex 1\nproperty list uchar int x\nproperty float y\nproperty float z\n",
            b"",
        )
    ),
    *(
        ("pcd", pcd(POINTS, "ascii", points).replace(b"1 1 2 1", b"1 1 2 %b" % count), "", "")
        for count in (b"1" * 5000, b"1" * 4000, b"99999999", b"-1")
        for points in (-1, 0)
    ),
    *(
        ("pcd", compressed_pcd(TWO_POINTS, bytes(24), packed), "", "")
        for packed in (
            b"",
            b"\x1f" + bytes(32),  # ends early
            b"\x0b" + bytes(12) + b"\x20\x0c",  # a reference before the start
            b"\x0b" + bytes(12) + b"\xe0\xff",  # a reference cut off
            b"\x0b" + bytes(12) + b"\xe0\xff\x00",  # more than is promised
            b"\x0b" + bytes(11),  # a run cut off
        )
    ),
    ("pcd", pcd(POINTS).replace(b"VIEWPOINT 0", b"VIEWPOINT nan"), "", ""),
    (
        "pcd",
        pcd(POINTS).replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 1 2"),
        "VIEWPOINT 1.0 2.0",
        "",
    ),
    ("xyz", b"", "no line of numbers", ""),
    ("xyz", b"# only\n", "no line of numbers", ""),
    ("xyz", b"0 0 0\n0 0\n", "from 3 to 2 at row 2", ""),
    ("xyz", b"0 0 0 1 0 0\n", "6 numbers in a line", ""),
    ("xyz", b"0 0 a\n", "'a'", ""),
]


@pytest.mark.parametrize("row", range(len(BAD_FILES)))
def test_a_bad_file_is_refused_by_value_and_fix(row: int) -> None:
    file_format, data, value, fix = BAD_FILES[row]
    with refusal("cloud", value, fix):
        read_file(file_format, data, MANY)


NORMALS = np.random.default_rng(2).normal(size=(40, 3)).astype(np.float32)
COLORS = np.random.default_rng(3).integers(0, 256, (40, 3)).astype(np.uint8)
IDS = np.arange(40, dtype=np.int32) % 5
IMAGES = {
    "depths": np.arange(60, dtype=np.uint16).reshape(6, 10) * 1001,
    "mask": np.eye(6, 10, dtype=bool),
    "grey": np.arange(60, dtype=np.uint8).reshape(6, 10),
    "colours": np.arange(180, dtype=np.uint8).reshape(6, 10, 3),
}


@pytest.mark.parametrize("name", IMAGES)
def test_png_images_are_read_whole_or_refused(name: str) -> None:
    whole = png(IMAGES[name])
    pixels = read_png(whole, MANY, name)
    np.testing.assert_array_equal(pixels, IMAGES[name])
    assert pixels.dtype == IMAGES[name].dtype
    for cut in range(0, len(whole) - 24, 7):  # checksums follow the pixels
        with refusal(name):
            read_png(whole[:cut], MANY, name)
    with refusal(name, kind=PayloadTooLarge):
        read_png(whole, 59, name)


def test_a_png_of_very_many_chunks_or_of_huge_size_is_not_unpacked() -> None:
    whole = png(IMAGES["depths"])
    empty = struct.pack(">I", 0) + b"tEXt" + struct.pack(">I", zlib.crc32(b"tEXt"))
    with refusal("depth", "chunks"):
        read_png(whole[:33] + empty * 200_000 + whole[33:], MANY, "depth")
    assert read_png(whole[:33] + empty * 20 + whole[33:], MANY, "depth").shape == (6, 10)
    small = bytearray(whole)
    small[16:24] = struct.pack(">II", 60_000, 60_000)
    small[29:33] = struct.pack(">I", zlib.crc32(small[12:29]))
    with bounded_memory(MIB), refusal("depth"):
        read_png(bytes(small), MANY, "depth")


def test_an_archive_of_a_depth_image_and_what_is_not_read() -> None:
    depth, rgb = np.full((4, 6), 500, np.uint16), np.zeros((4, 6, 3), np.uint8)
    matrix = np.array([[6.0, 0, 2.5], [0, 6.0, 1.5], [0, 0, 1]])
    for intrinsics in (matrix, np.array([6.0, 6.0, 2.5, 1.5])):
        data = npz(depth=depth, intrinsics=intrinsics, rgb=rgb, labels=depth)
        cloud = read_file("npz", data, MANY)
        assert np.shape(cloud.points) == np.shape(cloud.colors) == (4, 6, 3)
        np.testing.assert_allclose(cloud.points[1, 2], [-0.5 / 12, -0.5 / 12, 0.5], atol=1e-6)
        assert cloud.warnings == ("arrays of the file that are not read: labels.",)
    (warning,) = read_file("npz", npz(points=POINTS, colours=POINTS), MANY).warnings
    assert "colours" in warning
    with refusal("cloud.intrinsics"):
        read_file("npz", npz(depth=depth, intrinsics=np.ones(3)), MANY)


def test_arrays_beside_points_in_an_npz_file_are_read() -> None:
    arrays = {"normals": NORMALS, "colors": COLORS, "segment_ids": IDS, "view_ids": IDS}
    cloud = read_file("npz", npz(points=POINTS, **arrays), MANY)
    for name, array in arrays.items():
        np.testing.assert_array_equal(getattr(cloud, name), array)
    with refusal("segment_ids", kind=PayloadTooLarge):
        read_file("npz", npz(points=POINTS, segment_ids=np.zeros(1001, np.int32)), MANY)


@pytest.mark.parametrize("kind", ["F", "U"])
@pytest.mark.parametrize("height", [1, 4])
def test_normals_and_colours_of_a_pcd_file(kind: str, height: int) -> None:
    header = (
        "VERSION 0.7\nFIELDS x y z normal_x normal_y normal_z rgb\nSIZE 4 4 4 4 4 4 4\n"
        f"TYPE F F F F F F {kind}\nCOUNT 1 1 1 1 1 1 1\nWIDTH {40 // height}\nHEIGHT {height}\n"
        "POINTS 40\nDATA binary\n"
    )
    packed = (COLORS.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1)
    rows = np.concatenate([POINTS, NORMALS, packed.astype("<u4").view("<f4")[:, None]], axis=1)
    cloud = read_file("pcd", header.encode() + rows.astype("<f4").tobytes(), MANY)
    assert cloud.points.shape == ((40, 3) if height == 1 else (4, 10, 3))
    np.testing.assert_array_equal(cloud.points.reshape(-1, 3), POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS)
    np.testing.assert_array_equal(cloud.colors, COLORS)


def test_the_viewpoint_of_a_pcd_file() -> None:
    assert read_file("pcd", pcd(POINTS), MANY).viewpoint is None  # 0 0 0 in the file
    moved = pcd(POINTS).replace(b"VIEWPOINT 0 0 0", b"VIEWPOINT 0.1 0 -2")
    assert read_file("pcd", moved, MANY).viewpoint == (0.1, 0, -2)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_files_written_by_open3d(suffix: str, compressed: bool, text: bool, tmp_path) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS.astype(np.float64)))
    cloud.normals = open3d.utility.Vector3dVector(NORMALS.astype(np.float64))
    cloud.colors = open3d.utility.Vector3dVector(COLORS / 255)
    path = tmp_path / f"cloud.{suffix}"
    open3d.io.write_point_cloud(path, cloud, write_ascii=text, compressed=compressed)
    found = read_file(suffix, path.read_bytes(), MANY)
    close = 1e-5 if text else 1e-6  # it writes few digits of text
    np.testing.assert_allclose(found.points, POINTS, atol=close)
    if suffix == "xyz":
        assert found.normals is found.colors is None
        return
    np.testing.assert_allclose(found.normals, NORMALS, atol=close)
    scale = 255 if found.colors.dtype.kind == "f" else 1
    np.testing.assert_allclose(found.colors * scale, COLORS, atol=1.0)


def test_organised_clouds_keep_their_shape() -> None:
    organised = POINTS.reshape(5, 8, 3).copy()
    organised[2, 3] = np.nan
    rows = organised.astype(object)
    rows[2, 3] = None
    for points in (
        read_file("npy", npy(organised), MANY).points,
        read_file("npz", npz(points=organised), MANY).points,
        decode_points(rows.tolist(), MANY),
    ):
        np.testing.assert_array_equal(np.asarray(points, np.float32), organised)
    with pytest.raises(PayloadTooLarge):
        read_file("npy", npy(organised), 39)
    with pytest.raises(PayloadTooLarge):
        decode_points(organised.tolist(), 39)


def npz_of_many_members(disks: bytes = bytes(4)) -> bytes:
    """An archive; the end of its directory may hold another, of which a reader may take either."""
    entry = struct.Struct("<4s4B4HL2L5H2L")
    entries = b"".join(
        entry.pack(b"PK\1\2", 20, 3, 20, 0, *[0] * 4, 33, 0, 0, 6, *[0] * 6) + b"%06d" % number
        for number in range(60_000)
    )
    end = struct.pack("<4s4s2H2LH", b"PK\5\6", disks, 60_000, 60_000, len(entries), 4, 0)
    return b"PK\3\4" + entries + end


def pcd_bomb() -> bytes:
    count, size = 100_000, 12 + 8000
    header = (
        "VERSION 0.7\nFIELDS x y z a\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 1000\n"
        f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary_compressed\n"
    )
    packed = b"\0\0" + b"\xe0\xff\0" * (count * size // 264)
    return header.encode() + struct.pack("<II", len(packed), count * size) + packed


PLY = "ply\nformat ascii 1.0\nelement vertex {}\n"
PLY += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"

BOMBS: dict[str, Callable[[], bytes]] = {  # the format is the first word
    "npz ratio": lambda: npz_packed_by(zipfile.ZIP_DEFLATED, bytes(200 * MIB)),
    "npz lies": lambda: BOMBS["npz ratio"]().replace(
        struct.pack("<I", 200 * MIB), struct.pack("<I", 100)
    ),
    "npz members": npz_of_many_members,
    "npz two directories": lambda: npz_of_many_members(b"PK\5\6"),
    "npy shape": lambda: npy_of("'<f8'", "(999999999999, 3)"),
    "npy header": lambda: npy_with(b"{" + b" " * (8 * MIB - 1), 2),
    "ply header": lambda: b"ply\n" + b"\n" * (8 * MIB) + b"end_header\n",
    "ply count": lambda: PLY.format(1_999_999).encode() + b"0 0 0",
    "pcd header": lambda: b"".join(b"%x\n" % n for n in range(MIB)) + b"DATA ascii\n",
    "pcd compressed": pcd_bomb,
    "ply line": lambda: PLY.format(2).encode() + b"1 " * (4 * MIB),
    "xyz line": lambda: b"1 " * (4 * MIB),
    "xyz word": lambda: b"1" * (8 * MIB),
    "pcd columns": lambda: (
        pcd(POINTS, "ascii", 1).replace(b"1 1 1 2 1", b"1 1 1 %d 1" % (4 * MIB)) + b"1 " * (4 * MIB)
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_in_files_are_refused_within_the_memory_of_the_body(name: str) -> None:
    file_format, data = name.split()[0], BOMBS[name]()
    with bounded_memory(2 * len(data) + 16 * MIB), refusal("cloud"):
        read_file(file_format, data, 2_000_000)
