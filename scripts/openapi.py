"""Fill the OpenAPI document with what follows from the models that check requests.

proto/edgegrasp/v1/openapi.json is written by hand, but for the options and clouds of a request:
their schemas, and a query parameter for each option, come from the models.

usage: scripts/openapi.py [FOLDER]    writes edgegrasp/v1/openapi.json there, or into proto/
"""

import json
import sys
from pathlib import Path

from edgegrasp_model.options import DetectOptions
from edgegrasp_service.worker.request_cloud import DepthImage, PointCloud2

ROOT = Path(__file__).parents[1]
DOCUMENT = Path("edgegrasp/v1/openapi.json")
SCHEMAS = "#/components/schemas"
OPTIONS = f"{SCHEMAS}/DetectOptions/properties"
TIMEOUT = {"$ref": "#/components/parameters/Timeout"}
AS_TEXT = "With a point cloud file as body. As JSON; lists of numbers also as 0.1,0.2,0.3."


def document() -> str:
    """The document."""
    found = json.loads((ROOT / "proto" / DOCUMENT).read_text())
    schemas = found["components"]["schemas"]
    for model in (DetectOptions, PointCloud2, DepthImage):
        schema = model.model_json_schema(ref_template=f"{SCHEMAS}/{{model}}")
        schemas |= schema.pop("$defs", {}) | {model.__name__: schema}
    found["paths"]["/v1/grasps"]["post"]["parameters"] = [TIMEOUT] + [
        {
            "name": name,
            "in": "query",
            "description": f"{schema.get('description', '')}. {AS_TEXT}",
            "content": {"application/json": {"schema": {"$ref": f"{OPTIONS}/{name}"}}},
        }
        for name, schema in schemas["DetectOptions"]["properties"].items()
    ]
    return json.dumps(found, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "proto"
    (folder / DOCUMENT).write_text(document())
