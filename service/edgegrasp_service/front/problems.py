"""Errors as each transport tells them: problem documents of HTTP, trailing metadata of gRPC."""

import math
from typing import Any, NoReturn

import grpc
import orjson
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.duration_pb2 import Duration
from google.rpc.error_details_pb2 import (  # type: ignore[import-untyped]
    BadRequest,
    ErrorInfo,
    RetryInfo,
)
from google.rpc.status_pb2 import Status  # type: ignore[import-untyped]
from starlette.responses import Response

from edgegrasp.v1 import grasp_pb2
from edgegrasp_service.errors import Problem
from edgegrasp_service.observability import REQUEST_ID_HEADER, current_call
from edgegrasp_service.schemas import KIND_PREFIX

CHALLENGE = 'Bearer realm="edgegrasp"'
DOMAIN = "edgegrasp"  # of google.rpc.ErrorInfo
ERROR_METADATA = "edgegrasp-error-bin"  # trailing: an ErrorDetail
STATUS_METADATA = "grpc-status-details-bin"  # trailing: a google.rpc.Status


def problem_response(problem: Problem) -> Response:
    """The HTTP answer that tells of an error."""
    headers = {}
    if problem.retry_after is not None:
        headers["retry-after"] = str(math.ceil(problem.retry_after))
    if problem.status == 401:
        headers["www-authenticate"] = CHALLENGE
    document = problem_document(problem)
    return Response(document, problem.status, headers, "application/problem+json")


def problem_document(problem: Problem) -> bytes:
    """An error as a problem document (RFC 9457)."""
    return orjson.dumps(
        {
            "type": KIND_PREFIX + problem.kind,
            "title": problem.kind.replace("-", " ").capitalize(),
            "status": problem.status,
            "detail": problem.detail,
            "field": problem.field,
            "value": problem.value,
            "fix": problem.fix,
            "retry_after": problem.retry_after,
        }
    )


async def abort(context: Any, problem: Problem) -> NoReturn:
    """End a gRPC call with an error: ours and those of google.rpc, and the request's id."""
    call = current_call()
    call.problem, call.code = problem, problem.code
    code = grpc.StatusCode[problem.code]
    status = Status(code=code.value[0], message=problem.detail, details=_details(problem))
    trailing = (
        (ERROR_METADATA, error_detail(problem).SerializeToString()),
        (STATUS_METADATA, status.SerializeToString()),
        (REQUEST_ID_HEADER, call.request_id),
    )
    await context.abort(code, problem.detail, trailing)
    raise AssertionError("abort raises")


def error_detail(problem: Problem) -> grasp_pb2.ErrorDetail:
    """An error as the message of edgegrasp.v1."""
    return grasp_pb2.ErrorDetail(
        kind=problem.kind,
        field=problem.field,
        value=problem.value,
        fix=problem.fix,
        retry_after=problem.retry_after,
    )


def _details(problem: Problem) -> list[AnyMessage]:
    reason = problem.kind.upper().replace("-", "_")
    details: list[Any] = [ErrorInfo(reason=reason, domain=DOMAIN)]
    if problem.retry_after is not None:
        delay = Duration()
        delay.FromMilliseconds(int(problem.retry_after * 1000))
        details.append(RetryInfo(retry_delay=delay))
    if problem.field:
        violation = BadRequest.FieldViolation(field=problem.field, description=problem.detail)
        details.append(BadRequest(field_violations=[violation]))
    packed = [AnyMessage() for _ in details]
    for envelope, detail in zip(packed, details, strict=True):
        envelope.Pack(detail)
    return packed
