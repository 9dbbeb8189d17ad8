"""What planners ask for, by the protocol."""

from pathlib import Path

import numpy as np
import pytest

from edgegrasp_cli.flags import PlannerFlags
from edgegrasp_cli.planners import named_planner, open_planner, request_options
from edgegrasp_model.detector import WEIGHTS_FOLDER
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_sim.camera import Observation
from edgegrasp_sim.objects import SceneKind
from edgegrasp_sim.protocol import load_protocol
from edgegrasp_sim.simulation import ClutterSimulation
from edgegrasp_sim.trial import PlannedGrasp, RoundDriver, StartCollides

PAPER = load_protocol("edgegrasp").planning


def seen_under(name: str) -> Observation:
    with ClutterSimulation() as simulation:
        driver = RoundDriver(simulation, SceneKind.PACKED, load_protocol(name), seed=0, index=0)
        return driver.look()


def test_requests_follow_the_protocol() -> None:
    options = request_options(seen_under("edgegrasp"), 7, PAPER, {"num_candidates": 100})
    assert options["seed"] == 7
    assert (options["num_approach_points"], options["num_candidates"]) == (64, 100)
    assert options["support"]["offset"] == 0.05
    assert len(options["viewpoint"]) == 3
    giga = request_options(seen_under("giga"), 0, load_protocol("giga").planning, {})
    assert giga["support"]["offset"] == 0.05
    assert giga["support"]["max_depth_error"] == 0.12
    assert giga["workspace"]["min"][2] > 0.05
    six = request_options(seen_under("vgn"), 0, load_protocol("vgn").planning, {})
    assert np.shape(six["viewpoint"]) == (6, 3)


FEW = {"num_approach_points": 8, "num_candidates": 100}


def planned(**changes: object) -> PlannedGrasp:
    choice = PlannerFlags(planner="in-process", **changes)
    with open_planner(choice, PAPER, FEW) as made:
        grasp = made.make()(seen_under("edgegrasp"), 3)
    assert grasp is not None
    return grasp


def test_a_model_may_be_a_file_of_weights(tmp_path: Path) -> None:
    ablation = tmp_path / "no-augmentation.safetensors"
    ablation.write_bytes((WEIGHTS_FOLDER / "edgegrasp-plus.safetensors").read_bytes())
    file = PlannerFlags(planner="in-process", model=str(ablation))
    with open_planner(file, PAPER, {}) as made:
        assert len(made.facts["digest"]) == 64
    assert planned(model=str(ablation)).score == planned().score
    missing = PlannerFlags(planner="in-process", model=str(tmp_path / "none.safetensors"))
    with pytest.raises(ValueError, match="no such file"), open_planner(missing, PAPER, {}):
        pass
    elsewhere = PlannerFlags(model=str(ablation), server="127.0.0.1:1")
    with (
        pytest.raises(ValueError, match="server's own weights"),
        open_planner(elsewhere, PAPER, {}),
    ):
        pass


def test_a_view_in_which_the_arm_touches_the_table_is_told_from_other_errors() -> None:
    pytest.importorskip("roboplan", reason="the extra robot is not installed")
    from edgegrasp_cli.arm import benchmark_arm

    fields = benchmark_arm("fr3", load_protocol("edgegrasp").camera).options
    choice, asked = PlannerFlags(planner="in-process", robot="fr3"), FEW | fields
    fields["robot"]["T_base_cloud"][2][3] += 0.5  # the table, up to the hand
    with open_planner(choice, PAPER, asked) as made, pytest.raises(StartCollides, match="support"):
        made.make()(seen_under("edgegrasp"), 3)
    fields["robot"]["joints"] = [9.0] * 7
    with open_planner(choice, PAPER, asked) as made, pytest.raises(InvalidRequest, match="joint1"):
        made.make()(seen_under("edgegrasp"), 3)


def test_another_package_may_name_its_planner(tmp_path, monkeypatch) -> None:
    about = tmp_path / "their_package-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(
        "[edgegrasp.planners]\ntheirs = their_package:Planner\nbroken = their_package:Missing\n"
    )
    (tmp_path / "their_package.py").write_text(
        "class Planner:\n    def __call__(self, observation, seed): return None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert type(named_planner("theirs")).__module__ == "their_package"
    with pytest.raises(ValueError, match="'broken' cannot be loaded"):
        named_planner("broken")
    with pytest.raises(ValueError, match="in-process, broken, theirs, or module:callable"):
        named_planner("nobody")


@pytest.mark.parametrize("name", ["guess", "json:", ":loads", "json:no_such", "math:pi"])
def test_a_wrong_planner_is_told(name: str) -> None:
    with pytest.raises(ValueError, match=f"planner .*{name}"):
        named_planner(name)
