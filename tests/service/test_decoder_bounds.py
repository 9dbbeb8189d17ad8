"""What fuzzing found: input that once took a server's memory, or its answer."""

import tracemalloc
from collections.abc import Callable

import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import parse_options
from edgegrasp_service.cloud_decoding import decode_file, decode_list
from edgegrasp_service.errors import report
from edgegrasp_service.sent_arrays import array_from_lists

DEEP: list = []
for _ in range(5000):
    DEEP = [DEEP]


def refusal(work: Callable[[], object]) -> InvalidRequest:
    with pytest.raises(InvalidRequest) as caught:
        work()
    report(caught.value).detail.encode()
    assert len(report(caught.value).detail) < 2000
    return caught.value


@pytest.mark.parametrize("decode", [decode_list, lambda rows, _: array_from_lists("points", rows)])
def test_one_long_text_does_not_give_all_elements_its_room(decode: Callable) -> None:
    rows = [["x" * 100_000, "", ""]] + [["", "", ""]] * 2000
    tracemalloc.start()
    error = refusal(lambda: decode(rows, 10_000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000
    assert error.value.startswith("['xxx")


def test_whole_number_too_large_beside_a_hole() -> None:
    points = [[[None, None, None], [0, 0, 10**400]]]
    assert refusal(lambda: decode_list(points, 10)).value.startswith("[[None, None, None]")


def test_words_are_not_cut_off() -> None:
    """A number is read whole or not at all: its exponent comes last."""
    written = b"0.12345678901234567890123456789012e-05 0 0\n"
    cloud = decode_file("xyz", written, 10)
    assert cloud.points[0, 0] == 0.12345678901234567890123456789012e-05
    error = refusal(lambda: decode_file("xyz", b"0." + b"1" * 60 + b"e-05 0 0\n", 10))
    assert error.value == "a word of 66 characters in a .xyz file"


@pytest.mark.parametrize("value", ["x" * 100_000, {"k" * 100_000: 1}, DEEP, 10**4000])
def test_long_and_deep_values_are_told_briefly(value: object) -> None:
    for name in ("seed", "up", "support", "collision", "x" * 100_000):
        assert len(refusal(lambda name=name: parse_options({name: value})).value) <= 80
    refusal(lambda: decode_list([value], 10))


def test_half_a_character_is_told_in_whole_ones() -> None:
    """JSON can name one; UTF-8 cannot hold it, and no answer could be written."""
    told = report(InvalidRequest("\ud800", "an unknown field", "Remove it."))
    assert told.field == "\\ud800"
    assert told.detail.encode() == rb"\ud800: got an unknown field. Remove it."


def test_more_lists_than_points_have(raw_rest) -> None:
    """30 MB of empty lists once took 800 MB, and ten seconds in which nobody was answered."""
    content = b'{"points": [' + b"[]," * 200_000 + b"[]]}"
    answer = raw_rest.post(content=content, headers={"content-type": "application/json"})
    assert (answer.code, answer.field) == ("400", "body")
    assert answer.value == f"200003 lists and objects in {len(content)} bytes"


def test_the_shortest_points_and_edges_there_are(raw_rest) -> None:
    points = b"[0,0,0]," * 50_000 + b"[0,0,1]"
    edges = b",".join([b"[0,1]"] * 16_000)
    for path, beside in (("/v1/grasps", b""), ("/v1/grasps:score", b',"edges":[' + edges + b"]")):
        content = b'{"points":[' + points + b"]" + beside + b"}"
        answer = raw_rest.post(path, content=content, headers={"content-type": "application/json"})
        assert answer.code == "200", answer
