"""What the option schemas are made of."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

FARTHEST = 1e7  # metres from the origin, any way: beyond every place on Earth


def _no_text_or_truth(value: object) -> object:
    """Refuse what Python would convert to a number, such as true and "3"."""
    if isinstance(value, bool | str | bytes):
        raise ValueError("must be a number")
    return value


# Stands last in an annotation: pydantic writes wrong schemas for bounds that come after it.
numeric = BeforeValidator(_no_text_or_truth)
Integer = Annotated[int, numeric]
Number = Annotated[float, numeric]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-FARTHEST, le=FARTHEST), numeric]
Vector = Annotated[tuple[Finite, Finite, Finite], Field(description="x, y, z in the cloud's frame")]
Row = Annotated[int, Field(strict=True, ge=0, lt=2**31)]


def _of_length_one(value: tuple[float, ...]) -> tuple[float, ...]:
    if abs(float(np.linalg.norm(value)) - 1.0) > 1e-3:
        raise ValueError("must have length 1")
    return value


def _not_zero(value: tuple[float, ...]) -> tuple[float, ...]:
    if float(np.linalg.norm(value)) < 1e-6:
        raise ValueError("must not be the zero vector")
    return value


UnitVector = Annotated[Vector, AfterValidator(_of_length_one)]
Direction = Annotated[Vector, AfterValidator(_not_zero)]
Quaternion = Annotated[
    tuple[Finite, Finite, Finite, Finite],
    AfterValidator(_of_length_one),
    Field(description="x, y, z, w; length 1"),
]


class Strict(BaseModel):
    """Base of every option object: unknown fields are refused, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def ordered(low: tuple[float, ...], high: tuple[float, ...]) -> None:
    """Raise ValueError unless every coordinate of `low` is below that of `high`."""
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise ValueError("every coordinate of min must be below that of max")
