"""Record the answers of the code as it is: `python -m tests.answers.make`.

Answers are promised to stay what they are: record them again only for a change that is meant.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from edgegrasp_model.detector import ModelCatalogue
from edgegrasp_model.options import parse_options
from edgegrasp_model.scene.cloud import CloudInput

from .clouds import CASES, Case

DATA = Path(__file__).parent / "data"
GRASP_FIELDS = (
    "score",
    "T_cloud_hand",
    "T_cloud_tcp",
    "width",
    "approach_point",
    "contact_point",
    "approach_direction",
    "collision_free",
    "clearance",
)

Record = tuple[dict[str, Any], dict[str, np.ndarray]]


def answer(case: Case, catalogue: ModelCatalogue) -> Any:
    """The detection or scoring of a case, without a server."""
    cloud, asked = CloudInput(case.points, **case.beside), parse_options(case.options)
    detector = catalogue.get(asked.model)
    if case.given:
        return detector.score(cloud, asked, **case.given)
    return detector.detect(cloud, asked)


def record(answer: Any) -> Record:
    """What is kept of an answer, of the model's or of the client's: plain values and arrays."""
    plain = {"counts": dict(answer.counts), "model": answer.model, "warnings": len(answer.warnings)}
    grasps = getattr(answer, "grasps", None)
    if grasps is None:
        plain["reasons"] = [each.reason and str(each.reason) for each in answer.evaluations]
        grasps = [each.grasp for each in answer.evaluations if each.grasp is not None]
    arrays = {
        name: np.array([getattr(grasp, name) for grasp in grasps], dtype=np.float32)
        for name in GRASP_FIELDS
    }
    return plain, arrays


def load(name: str) -> Record:
    """The recorded answer of a case."""
    with np.load(DATA / f"{name}.npz") as arrays:
        found = dict(arrays)
    return json.loads(str(found.pop("plain"))), found


def main() -> None:
    catalogue = ModelCatalogue.load()
    for name, make in CASES.items():
        plain, arrays = record(answer(make(), catalogue))
        np.savez_compressed(DATA / f"{name}.npz", plain=np.array(json.dumps(plain)), **arrays)


if __name__ == "__main__":
    main()
