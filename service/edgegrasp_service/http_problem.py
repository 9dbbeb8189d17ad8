"""Errors as HTTP tells them: problem documents, and the headers that belong to a status."""

import math

from fastapi.responses import JSONResponse

from edgegrasp_service.errors import ErrorReport
from edgegrasp_service.http_bodies import problem_body

CHALLENGE = 'Bearer realm="edgegrasp"'


def problem_response(problem: ErrorReport) -> JSONResponse:
    """The answer that tells of an error."""
    headers = {}
    if problem.retry_after is not None:
        headers["retry-after"] = str(math.ceil(problem.retry_after))
    if problem.status == 401:
        headers["www-authenticate"] = CHALLENGE
    return JSONResponse(
        problem_body(problem),
        problem.status,
        headers=headers,
        media_type="application/problem+json",
    )
