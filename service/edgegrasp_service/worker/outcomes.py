"""What became of grasps: one line each in a file, for `edgegrasp train --outcomes`."""

from datetime import UTC, datetime
from typing import Any

import orjson
from pydantic import BaseModel, ConfigDict, Field

from edgegrasp_service.errors import PayloadTooLarge, UnsupportedMediaType
from edgegrasp_service.worker.http_bodies import JSON, read_json
from edgegrasp_service.worker.job import Job
from edgegrasp_service.worker.request_cloud import parse

MAX_BYTES = 64 * 2**20  # size at which the file takes no more


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
    with path.open("ab") as file:
        if file.tell() > MAX_BYTES:
            raise PayloadTooLarge("outcomes", "more than the file takes", "Move the file away.")
        file.write(orjson.dumps(line) + b"\n")  # one write: lines of several workers stay whole
    return b"{}"
