import json
from dataclasses import replace

import pytest

from edgegrasp_model.network_config import (
    EDGEGRASP,
    EDGEGRASP_SMALL,
    VN_EDGEGRASP,
    NetworkConfig,
)


@pytest.mark.parametrize("config", [EDGEGRASP, VN_EDGEGRASP, EDGEGRASP_SMALL])
def test_a_config_survives_json(config):
    assert NetworkConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": "gpd"}, "architecture: got 'gpd'. Use one of: edgegrasp, vn-edgegrasp"),
        ({"conv_widths": (32, 64)}, r"conv_widths: got \(32, 64\). Give 3 positive whole numbers"),
        ({"global_widths_2": (8, 0)}, r"global_widths_2: got \(8, 0\)"),
        ({"classifier_widths": ()}, r"classifier_widths: got \(\)"),
        ({"classifier_widths": (8.5,)}, r"classifier_widths: got \(8.5,\)"),
        ({"hand_description_size": -1}, "hand_description_size: got -1"),
        ({"k": 0}, "k: got 0"),
        ({"crop_radius": 50.0}, "crop_radius: got 50.0. Give metres"),
    ],
)
def test_a_field_out_of_range_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        replace(EDGEGRASP, **change)


def test_unknown_and_missing_fields_are_named():
    values = EDGEGRASP.to_dict()
    with pytest.raises(ValueError, match="unknown fields dropout"):
        NetworkConfig.from_dict(values | {"dropout": 0.1})
    del values["conv_widths"]
    with pytest.raises(ValueError, match="conv_widths"):
        NetworkConfig.from_dict(values)
