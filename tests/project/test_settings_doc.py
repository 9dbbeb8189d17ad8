"""docs/settings.md is what its script writes, and names every setting."""

import importlib.util
import re
from pathlib import Path

from edgegrasp_cli.connection import TOKEN_VARIABLE
from edgegrasp_service.metrics import Metrics
from edgegrasp_service.settings import Settings

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_is_up_to_date() -> None:
    spec = importlib.util.spec_from_file_location("make_settings", DOCS / "make_settings.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (DOCS / "settings.md").read_text() == module.page(), "run python docs/make_settings.py"


def test_the_page_names_every_setting() -> None:
    named = re.findall(r"^\| `(\w+)` \|", (DOCS / "settings.md").read_text(), flags=re.MULTILINE)
    assert named == list(Settings.model_fields)


def test_variables_that_the_pages_name_exist() -> None:
    known = {f"EDGEGRASP_{name.upper()}" for name in Settings.model_fields}
    beside = [DOCS.parent / name for name in ("README.md", "Dockerfile", "docker/compose.yaml")]
    for page in (*DOCS.glob("*.md"), *beside):
        named = set(re.findall(r"\bEDGEGRASP_[A-Z_]+", page.read_text()))
        assert named <= {*known, "EDGEGRASP_CONFIG", TOKEN_VARIABLE, "EDGEGRASP_"}, page.name


def test_metrics_are_those_of_the_page() -> None:
    metrics = Metrics([])
    exist = {
        f"{family.name}_total" if family.type == "counter" else family.name
        for family in metrics.registry.collect()
        if family.name.startswith("edgegrasp_")
    }
    added = {"edgegrasp_model_info", "edgegrasp_ready", "edgegrasp_log_lines_dropped"}
    table = (DOCS / "serving.md").read_text().partition("| metric |")[2].partition("\n\n")[0]
    assert set(re.findall(r"edgegrasp_\w+", table)) == exist | added
