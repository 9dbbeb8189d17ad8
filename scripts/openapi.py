"""Fill the OpenAPI document with what follows from the models that check requests.

proto/edgegrasp/v1/openapi.json is written by hand, except the options and clouds of a request:
their schemas, and a query parameter for each option, come from the models.

usage: scripts/openapi.py [FOLDER]    writes edgegrasp/v1/openapi.json there, or into proto/
"""

import json
import sys
from pathlib import Path
from typing import Any

from edgegrasp_model.options import DetectOptions
from edgegrasp_model.request_cloud import DepthImage, PointCloud2

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
    for form in (schemas[name]["properties"] for name in ("DetectForm", "ScoreForm")):
        camera = schemas["DepthImage"]["properties"]
        form |= {name: camera[name] for name in camera if name != "depth"}
        form["depth"]["anyOf"] = [{"$ref": f"{SCHEMAS}/File"}, camera["depth"]]
    found["paths"]["/v1/grasps"]["post"]["parameters"] = [TIMEOUT] + [
        {
            "name": name,
            "in": "query",
            "description": f"{schema.get('description', '')}. {AS_TEXT}",
            "content": {"application/json": {"schema": {"$ref": f"{OPTIONS}/{name}"}}},
        }
        for name, schema in schemas["DetectOptions"]["properties"].items()
    ]
    return json.dumps(_for_generators(found, schemas), indent=1, ensure_ascii=False) + "\n"


def _for_generators(part: Any, schemas: dict[str, Any]) -> Any:
    """The document as generators of clients read it.

    They follow references to schemas, but not to properties of these; they refuse defaults that
    are objects or lists, and take a field with a default for one that is always there.
    """
    if isinstance(part, list):
        return [_for_generators(each, schemas) for each in part]
    if not isinstance(part, dict):
        return part
    path = str(part.get("$ref", "")).removeprefix(f"{SCHEMAS}/").split("/")
    if path[1:2] == ["properties"]:
        more = {key: value for key, value in part.items() if key != "$ref"}
        return _for_generators(schemas[path[0]]["properties"][path[2]] | more, schemas)
    found = {key: _for_generators(value, schemas) for key, value in part.items()}
    if "default" in found and not isinstance(found["default"], dict):
        default = found.pop("default")
        said = f"default {json.dumps(default)}"
        if default not in (None, []) and said not in found.get("description", ""):
            found["description"] = f"{found.get('description', '')}; {said}".removeprefix("; ")
    elif "default" in found and "type" not in found["default"]:
        del found["default"]  # a value; the schema of a field named `default` has a type
    return found


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "proto"
    (folder / DOCUMENT).write_text(document())
