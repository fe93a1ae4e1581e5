"""The JSON Schema of the strict file models, for programs that write or read these files without Python."""

from typing import Any

from fpp_ml_bench.evaluation.protocol import RESULT_SCHEMA_VERSION
from fpp_ml_bench.evaluation.report import Comparison
from fpp_ml_bench.evaluation.result.result_model import Result
from fpp_ml_bench.evaluation.schema import StrictModel
from fpp_ml_bench.evaluation.submission import Submission

MODELS: dict[str, type[StrictModel]] = {"result": Result, "submission": Submission, "comparison": Comparison}


def json_schema(name: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of ``result``, ``submission`` or ``comparison``.

    It lists the keys and what each may hold. Whether averages follow from the samples is checked on reading.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"fpp-ml-bench {name}, schema version {RESULT_SCHEMA_VERSION}",
        **{key: value for key, value in MODELS[name].model_json_schema().items() if key != "title"},
    }
