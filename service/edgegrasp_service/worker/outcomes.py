"""What became of grasps: one line each in a file, for `edgegrasp train --outcomes`."""

from datetime import UTC, datetime
from typing import Any

import orjson
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from edgegrasp_model.options import invalid_options
from edgegrasp_service.errors import PayloadTooLarge
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker.http_bodies import read_json


class TriedGrasp(BaseModel):
    """A grasp that a robot tried."""

    model_config = ConfigDict(extra="forbid")

    model: str = Field(min_length=1, max_length=200, description="weights that scored it")
    score: float = Field(ge=0.0, le=1.0, description="as it was answered")
    held: bool = Field(description="whether it held")
    request_id: str = Field("", max_length=200, description="of the request that found it")


def append(body: bytes, catalogue: Any, settings: Settings) -> bytes:
    """Append a grasp and the digest of its weights; raises InvalidRequest or PayloadTooLarge."""
    fields = read_json("body", body)
    try:
        tried = TriedGrasp.model_validate(fields)
    except ValidationError as error:
        raise invalid_options(error, fields, "body") from None
    catalogue.get(tried.model)  # or it is unknown
    digest = {row["name"]: row["digest"] for row in catalogue.describe()}[tried.model]
    line = tried.model_dump() | {"digest": digest, "time": datetime.now(UTC).isoformat()}
    assert settings.outcomes_file is not None
    with settings.outcomes_file.open("ab") as file:
        if file.tell() > settings.outcomes_bytes:
            raise PayloadTooLarge("outcomes", "more than outcomes_bytes", "Move the file away.")
        file.write(orjson.dumps(line) + b"\n")  # one write: lines of several workers stay whole
    return b"{}"
