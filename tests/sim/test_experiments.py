"""What an experiment varies, and how its figures are shown."""

from pathlib import Path

import pytest

from edgegrasp_sim.experiments import EXPERIMENTS, Case, cases_of
from edgegrasp_sim.objects import FAMILIES, SceneKind
from edgegrasp_sim.protocol import load_protocol

PAPER = load_protocol("edgegrasp")


def cases(name: str, folder: Path) -> list[Case]:
    model = "runs/3000/edgegrasp-plus.safetensors" if name == "labels" else "edgegrasp-plus"
    return cases_of(name, PAPER, list(SceneKind), [model], folder)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_case_has_a_folder_of_its_own(name: str, tmp_path: Path) -> None:
    names = [case.name for case in cases(name, tmp_path)]
    assert len(set(names)) == len(names) > 1
    assert all(len(each) < 100 and "/" not in each and " " not in each for each in names)


def test_robustness_changes_one_thing_at_a_time(tmp_path: Path) -> None:
    groups: dict[str, list[Case]] = {}
    for case in cases("robustness", tmp_path):
        groups.setdefault(case.group, []).append(case)
    giga = load_protocol("giga")
    plain, moved, full = (case.protocol for case in groups["view"][:3])
    assert (plain, full) == (PAPER, giga)
    assert (moved.camera, moved.noise) == (giga.camera, PAPER.noise)
    for case in (*groups["noise (mm)"], *groups["camera's polar angle (degrees)"]):
        rules = case.protocol
        changed = [part for part in ("scene", "round", "camera", "noise", "planning")
                   if getattr(rules, part) != getattr(PAPER, part)]  # fmt: skip
        assert len(changed) <= 1
        assert rules.name != PAPER.name  # not to be taken for the paper's
        assert set(case.planner) == {"model"}


def test_labels_are_what_the_folders_say(tmp_path: Path) -> None:
    models = ["runs/900/plus.safetensors", "runs/3000/plus.safetensors"]
    found = cases_of("labels", PAPER, [SceneKind.PILE], models, tmp_path)
    assert [(case.value, case.planner) for case in found] == [
        (900.0, {"model": models[0]}),
        (3000.0, {"model": models[1]}),
    ]
    for model in ("edgegrasp-plus", "runs/new/plus.safetensors"):
        with pytest.raises(ValueError, match=rf"{model}.*runs/3000/"):
            cases_of("labels", PAPER, [SceneKind.PILE], [model], tmp_path)


def test_families_have_folders_of_their_own_and_keep_their_size(tmp_path: Path) -> None:
    found = cases("families", tmp_path)
    assert {case.objects for case in found} == {tmp_path / "objects" / name for name in FAMILIES}
    assert all(case.protocol.scene.pile_scale == (1.0, 1.0) for case in found)
