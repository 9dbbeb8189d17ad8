import json
from dataclasses import replace

import pytest

from edgegrasp_model.networks.config import (
    EDGEGRASP,
    EDGEGRASP_SMALL,
    HAND,
    VN_EDGEGRASP,
    NetworkConfig,
)


@pytest.mark.parametrize("config", [EDGEGRASP, VN_EDGEGRASP, EDGEGRASP_SMALL, HAND])
def test_a_config_survives_json(config):
    assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": "gpd"}, "architecture: got 'gpd'. Use one of: edgegrasp, edgegrasp-int8"),
        ({"conv_widths": (32, 64)}, r"conv_widths: got \(32, 64\). Give 3 positive whole numbers"),
        ({"global_widths_2": (8, 0)}, r"global_widths_2: got \(8, 0\)"),
        ({"classifier_widths": ()}, r"classifier_widths: got \(\)"),
        ({"classifier_widths": (8.5,)}, r"classifier_widths: got \(8.5,\)"),
        ({"hand_widths": (8,)}, r"hand_widths: got \(8,\). Give 0 positive"),
        ({"hand_points": 0}, "hand_points: got 0"),
        ({"k": 0}, "k: got 0"),
        ({"crop_radius": 50.0}, "crop_radius: got 50.0. Give metres"),
    ],
)
def test_a_field_out_of_range_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        replace(EDGEGRASP, **change)


def test_the_hand_network_takes_no_balls():
    with pytest.raises(ValueError, match=r"conv_widths: got \(8, 8, 8\)"):
        replace(HAND, conv_widths=(8, 8, 8))
    with pytest.raises(ValueError, match=r"hand_widths: got \(\)"):
        replace(HAND, hand_widths=())


def test_unknown_and_missing_fields_are_named():
    values = EDGEGRASP.to_dict()
    with pytest.raises(ValueError, match="unknown fields dropout"):
        NetworkConfig.from_dict(values | {"dropout": 0.1})
    del values["conv_widths"]
    with pytest.raises(ValueError, match=r"conv_widths: got \(\)"):
        NetworkConfig.from_dict(values)
