"""Objects of a request other than its options, checked against their schemas."""

import base64
import binascii
from typing import Annotated, TypeVar

from pydantic import BaseModel, BeforeValidator, ValidationError

from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.options import invalid_options

Schema = TypeVar("Schema", bound=BaseModel)


def _from_base64(value: object) -> object:
    """JSON has no bytes; gRPC does."""
    if not isinstance(value, str):
        return value
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("must be base64") from None


Bytes = Annotated[bytes, BeforeValidator(_from_base64, json_schema_input_type=str)]


def parse_fields(schema: type[Schema], fields: object, name: str) -> Schema:
    """Check plain values against a schema.

    Args:
        schema: What they should be.
        fields: Decoded JSON, or the same from a message, with bytes in the place of base64.
        name: What they are called in the request.

    Raises:
        InvalidRequest: A field is missing, unknown, of the wrong type or out of range.
    """
    try:
        return schema.model_validate(fields)
    except ValidationError as error:
        problem = invalid_options(error, fields, name)
        if error.errors(include_url=False)[0]["type"] == "extra_forbidden":
            problem = InvalidRequest(problem.field, problem.value, "Remove it.")
        if problem.value.startswith(("'", "b'")) and problem.field.endswith(".data"):
            problem = InvalidRequest(problem.field, "no base64", "Send base64 in JSON.")
        raise problem from None
