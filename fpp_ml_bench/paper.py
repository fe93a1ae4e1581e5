"""What the authors of the benchmark paper report, in ``paper_rows.json``, typed in by hand. Nothing
there is measured by this package."""

import json
from functools import cache
from pathlib import Path
from typing import Any

LAYERS = {
    **{name: name for name in ("enc1", "enc2", "enc3", "enc4", "bottleneck")},
    **{f"dec{level}": f"dec{5 - level}" for level in (4, 3, 2, 1)},
}
"""The paper's name of each of our UNet's layers: our dec4 is the coarsest, the paper's dec1 is."""
AVERAGE = "average"


@cache
def paper_rows() -> dict[str, Any]:
    """``tables`` of errors by the keys ``columns``, and ``probes``."""
    content: dict[str, Any] = json.loads(
        Path(__file__).with_name("paper_rows.json").read_text(encoding="utf-8")
    )
    return content


def paper_layers(probe: str) -> dict[str, dict[str, float]]:
    """The values of Table 7 (``linear_probing``) or 8 (``grad_cam``) by our names of the layers,
    and their `AVERAGE`: ``edges_mse``, ``depth_mse``, or ``r_edges``, ``r_fringes``; and
    ``ratio``."""
    table = paper_rows()["probes"][probe]
    ours = {theirs: name for name, theirs in LAYERS.items()} | {AVERAGE: AVERAGE}
    return {
        ours[name]: dict(zip(table["columns"], row, strict=True))
        for name, row in table["layers"].items()
    }
