"""What became of grasps: one line each in a file, for `edgegrasp train --outcomes`."""

from datetime import UTC, datetime
from typing import Any

import orjson
from pydantic import BaseModel, ConfigDict, Field

from edgegrasp_model.options import parse
from edgegrasp_service.errors import UnsupportedMediaType
from edgegrasp_service.recording import append_line
from edgegrasp_service.worker.http_bodies import JSON, read_json
from edgegrasp_service.worker.job import Job


class TriedGrasp(BaseModel):
    """A grasp that a robot tried."""

    model_config = ConfigDict(extra="forbid")

    model: str = Field(min_length=1, max_length=200, description="weights that scored it")
    score: float = Field(ge=0.0, le=1.0, description="as it was answered")
    held: bool = Field(description="whether it held")
    request_id: str = Field("", max_length=200, description="of the request that found it")


def append(job: Job, catalogue: Any, path: Any) -> bytes:
    """Append a grasp and the digest of its weights; raises an EdgeGraspError of a bad request."""
    if not job.content_type.lower().startswith(JSON):  # which no foreign web page can send
        raise UnsupportedMediaType("Content-Type", repr(job.content_type[:40]), f"Send {JSON}.")
    tried = parse(TriedGrasp, read_json("body", job.body), "body")
    catalogue.get(tried.model)  # or it is unknown
    digest = {row["name"]: row["digest"] for row in catalogue.describe()}[tried.model]
    line = tried.model_dump() | {"digest": digest, "time": datetime.now(UTC).isoformat()}
    append_line(path, orjson.dumps(line) + b"\n")
    return b"{}"
