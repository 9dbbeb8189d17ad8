import pytest

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import DetectOptions, parse_options


def test_no_fields_are_the_defaults() -> None:
    assert parse_options({}) == DetectOptions()


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"seed": -1}, "options.seed"),
        ({"seed": 1.5}, "options.seed"),
        ({"sede": 1}, "options.sede"),
        ({"top_k": 0}, "options.top_k"),
        ({"num_approach_points": 1000}, "options.num_approach_points"),
        ({"num_candidates": 10**9}, "options.num_candidates"),
        ({"min_score": 1.5}, "options.min_score"),
        ({"viewpoint": [0, 0]}, "options.viewpoint.2"),
        ({"viewpoint": [0, 0, float("nan")]}, "options.viewpoint.2"),
        ({"up": [0, 0, 0]}, "options.up"),
        ({"collision": "maybe"}, "options.collision"),
        ({"workspace": {"min": [0, 0, 0], "max": [0, 1, 1]}}, "options.workspace"),
        ({"workspace": {"min": [0, 0, 0]}}, "options.workspace.max"),
        ({"support": {"normal": [0, 0, 2], "offset": 0}}, "options.support.normal"),
        ({"suppression": {"translation": -1}}, "options.suppression.translation"),
        ([], "options"),
    ],
)
def test_a_wrong_field_is_named_with_its_value(fields: object, field: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        parse_options(fields)
    assert caught.value.field == field
    assert caught.value.value
    assert caught.value.fix
