import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgegrasp_sim.protocol import FOLDER, load_protocol, protocol_from, protocol_names


def test_a_protocol_comes_back_from_a_manifest() -> None:
    for name in protocol_names():
        protocol = load_protocol(name)
        assert protocol_from(json.loads(json.dumps(protocol.to_json()))) == replace(
            protocol, engine="", kind=None
        )


def test_the_side_view_is_where_giga_has_it() -> None:
    (view,) = load_protocol("giga").camera.view_range().sample(np.random.default_rng(0))
    expected = [0.15, 0.15 - 0.6 * np.sin(np.pi / 3), 0.10 + 0.6 * np.cos(np.pi / 3)]
    np.testing.assert_allclose(view[:3, 3], expected, atol=1e-9)


def test_a_file_gives_what_differs_from_its_base(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('base = "ur5-pile"\nname = "own"\n[camera]\nviews = 2\n')
    own, base = load_protocol(str(file)), load_protocol("ur5-pile")
    assert own == replace(base, name="own", camera=replace(base.camera, views=2))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("views = 1", "", "camera.views: Field required"),
        ("views = 1", "views = 1\nzoom = 2", "camera.zoom: Unexpected"),
        ('table = "known"', 'table = "guess"', "planning.table: .* 'known', 'seen', 'around'"),
        ("version = 3", "version = ", "protocol .*toml"),
        ("version = 3", 'version = 3\nbase = "nobody"', "base is 'nobody'; name one of bin"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = tmp_path / "own.toml"
    file.write_text((FOLDER / "edgegrasp.toml").read_text().replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_protocol(str(file))
