"""Building blocks of the strict file models: types of text and numbers, and readable errors."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_serializer

from fpp_ml_bench.errors import FppBenchError, SubmissionError
from fpp_ml_bench.files import LARGEST, NAME_LIMIT, printable, text_problem

MAX_PROBLEMS = 50
LONGEST_REASON = 2000
"""Characters of a few sentences, such as why a method refuses a rig."""
Model = TypeVar("Model", bound="StrictModel")


def _of_length(limit: int) -> AfterValidator:
    def checked(value: str) -> str:
        if problem := text_problem(value, limit):
            raise ValueError(problem)
        return value

    return AfterValidator(checked)


def as_tuple(value: Any) -> Any:
    """For a field that is a tuple, which files write as a list."""
    return tuple(value) if isinstance(value, list) else value


def _not_tiny(value: float) -> float:
    if value < 1 / LARGEST:
        raise ValueError(f"expected at least {1 / LARGEST:g}")
    return value


Text = Annotated[str, _of_length(NAME_LIMIT)]
Reason = Annotated[str, _of_length(LONGEST_REASON)]
Scalar = Text | bool | int | float | None
Positive = Annotated[float, Field(gt=0), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]


class StrictModel(BaseModel):
    """No unknown keys, no coercion (``"3"`` is no 3, ``true`` no 1), no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class SparseModel(StrictModel):
    """Keys in ``SPARSE`` are not written where they hold their default, so that files without them
    stay as they are."""

    SPARSE: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        for key in self.SPARSE:
            if getattr(self, key) == type(self).model_fields[key].default:
                content.pop(key, None)
        return content


def problems_of(error: ValidationError) -> list[str]:
    """A line for each problem: the key, what is wrong, the value; safe to print."""
    lines = []
    for item in error.errors(include_url=False, include_context=False)[:MAX_PROBLEMS]:
        where = ".".join(printable(str(part), 60) for part in item["loc"]) or "the file as a whole"
        message = item["msg"].removeprefix("Value error, ")
        if item["type"] == "missing":
            lines.append(f"{where}: is missing")
        elif item["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            lines.append(f"{where}: is not a key of this file; remove it or correct its spelling")
        elif item["loc"] and isinstance(item["input"], str | int | float | bool | type(None)):
            lines.append(f"{where}: {message} (got {printable(repr(item['input']), 60)})")
        else:
            lines.append(f"{where}: {message}")
    return lines


def validate(
    model: type[Model],
    value: Any,
    path: Path,
    kind: str,
    raised: type[FppBenchError] = SubmissionError,
) -> Model:
    """``value`` as ``model``, or the error ``raised`` naming ``path`` and every key that is
    wrong."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        lines = "\n  ".join(problems_of(error))
        raise raised(f"{printable(str(path), 500)} is no valid {kind}:\n  {lines}") from None
