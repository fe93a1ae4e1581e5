"""The front door: seven functions that open, decode, score and rank.

Like the commands, this module may import every subpackage; none of them imports it. Each function
imports what it needs when it is called.

>>> import fpp_ml_bench as fpp
>>> dataset = fpp.open_dataset("data/mini")
>>> sample = dataset.samples("test")[0]
>>> decoded = fpp.decode(dataset.frames(sample, range(52)), dataset.rig)
>>> decoded.depth_mm.shape == dataset.size
True
"""

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from fpp_ml_bench.decoding.decode import Decoded, decode_stack
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.report.comparison import Comparison
from fpp_ml_bench.evaluation.report.comparison import compare as compare_results
from fpp_ml_bench.evaluation.result.model import ArrayScores, Result
from fpp_ml_bench.evaluation.score.evaluator import evaluate as evaluate_folder
from fpp_ml_bench.evaluation.score.evaluator import evaluate_arrays
from fpp_ml_bench.loaders.storage.store import DatasetFolder, load_dataset

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fpp_ml_bench.baselines.method import Method
    from fpp_ml_bench.evaluation.score.evaluator import Maps
    from fpp_ml_bench.leaderboard.ranking import Group
    from fpp_ml_bench.optics.rig import Rig

__all__ = ["compare", "decode", "evaluate", "load_dataset", "load_method", "open_dataset", "rank"]


def open_dataset(folder: str | Path) -> "DatasetFolder":
    """Open a dataset folder for single images as read-only NumPy views, without a copy.

    Parameters
    ----------
    folder : str or Path
        Dataset written by ``fpp-bench build`` or ``fpp-bench import``.

    Returns
    -------
    DatasetFolder
        ``samples(split)`` names the samples; ``frame(sample, index)`` is uint8 (H, W), ``depth_mm(sample)`` float32
        (H, W) in mm with 0 = background; ``rig`` is the calibration.

    Raises
    ------
    DatasetError
        For a folder that is no finished dataset.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> dataset = fpp.open_dataset("data/mini")
    >>> dataset.frame(dataset.samples("test")[0], 0).dtype
    dtype('uint8')
    """
    return DatasetFolder(folder)


def load_method(
    name: str | Path, dataset: "DatasetFolder", *, trust: bool = False, **options: Any
) -> "Method":
    """A method that turns frames into depth, ready for a dataset's rig and image size.

    Parameters
    ----------
    name : str or Path
        ``classical``, ``phase``, ``crossed`` and the other methods of ``fpp-bench predict``, a class of yours as
        ``mine.py:Mine``, shipped weights, a ``.safetensors`` file, or ``hf://OWNER/NAME``, a model repository of the
        Hugging Face Hub.
    dataset : DatasetFolder
        What it is to run on; see `open_dataset`.
    trust : bool
        Whether code that a repository of the Hub brings may run.
    **options
        The method's settings: ``steps=4`` (classical), ``frames=3`` (phase), ``direction="vertical"`` (both),
        ``frame=7`` (networks).

    Returns
    -------
    Method
        ``predict(frames)`` takes a list of uint8 (H, W) frames (None where ``frames_used`` does not name one) and gives
        depth float32 (H, W) in mm, 0 = background or not measured.

    Raises
    ------
    FppBenchError
        For an unknown method, and for settings or data that do not fit it.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> dataset = fpp.open_dataset("data/mini")
    >>> method = fpp.load_method("classical", dataset, steps=4)
    >>> len(method.frames_used) < 52
    True
    """
    from fpp_ml_bench.baselines import registry

    return registry.load_method(name, dataset, trust=trust, **options)


def decode(
    frames: "Sequence[NDArray[np.uint8] | None]",
    rig: "Rig",
    direction: str = "both",
    steps: int | None = None,
    mask: "NDArray[np.bool_] | None" = None,
) -> "Decoded":
    """Depth from a captured sequence: N-step phase, Gray-code order, triangulation (paper Section
    2.1).

    Parameters
    ----------
    frames : sequence of uint8 (H, W)
        All frames of ``rig.sequence`` in order; a frame that is not needed may be None.
    rig : Rig
        Calibration of camera and projector.
    direction : {"both", "horizontal", "vertical"}
        Which fringes to use.
    steps : int, optional
        How many of each direction's sinusoids, 3 to N; default all.
    mask : bool (H, W), optional
        Pixels to decode; the others stay 0.

    Returns
    -------
    Decoded
        ``depth_mm`` float32 (H, W), 0 where nothing was measured, and ``reason`` (uint8 (H, W), codes of
        `fpp_ml_bench.coding.Reason`).

    Raises
    ------
    DecodeError
        For frames, steps or a mask that do not fit, and for a frame whose capture failed.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> dataset = fpp.open_dataset("data/mini")
    >>> frames = dataset.frames(dataset.samples("test")[0], range(52))
    >>> bool((fpp.decode(frames, dataset.rig, steps=4).depth_mm > 0).any())
    True
    """
    return decode_stack(frames, rig, direction, steps, mask)  # type: ignore[arg-type]


@overload
def evaluate(
    predictions: str | Path,
    dataset: "str | Path | DatasetFolder",
    split: str = "test",
    target: str = "depth",
    *,
    mode: str = "standard",
    edge_band_px: int = EDGE_BAND_PX,
) -> "Result": ...


@overload
def evaluate(
    predictions: "Maps",
    dataset: "Maps",
    *,
    flags: "Maps | None" = None,
    sigma: "Maps | None" = None,
    objects: Sequence[str] | None = None,
    units: str | None = None,
    nodata: float | None = None,
    charge_mm: float | None = None,
    edge_band_px: int = EDGE_BAND_PX,
) -> "ArrayScores": ...


def evaluate(
    predictions: Any,
    dataset: Any,
    split: str = "test",
    target: str = "depth",
    *,
    mode: str = "standard",
    edge_band_px: int = EDGE_BAND_PX,
    flags: Any = None,
    sigma: Any = None,
    objects: Any = None,
    units: Any = None,
    nodata: Any = None,
    charge_mm: float | None = None,
) -> "Result | ArrayScores":
    """Score a folder of predictions, as ``fpp-eval`` does, or arrays in memory by the same rules.

    Parameters
    ----------
    predictions : str or Path, or array
        Folder with a ``submission.yaml`` and a prediction for each sample of the split. Or depth in mm along the
        camera's axis (not along the ray), 0 = not measured: floats (N, H, W), or a list of maps (H, W).
    dataset : str, Path or DatasetFolder, or array
        What was predicted. For arrays, the true depth in mm, 0 = background, in the form of the predictions; pixels
        that a masked array masks count in no score.
    split : {"train", "validation", "test"}
        Of a folder: its samples must all be there, and no others.
    target : {"depth", "depth_exact"}
        Of a folder: decoded depth as in the paper, or the exact depth of generated data.
    mode : {"standard", "paper"}
        Of a folder: void pixels in no set, or the paper's sets, without void.
    edge_band_px : int
        Object pixels nearer than this to a depth edge count as edge.
    flags : array, optional
        Of arrays: whole numbers, the column ``flags`` of the data; unlit and mixed pixels are void.
    sigma : array, optional
        Of arrays: the stated standard uncertainty in mm, 0 where none is stated.
    objects : sequence of str, optional
        Of arrays: what each sample shows; intervals are over objects. By default, each sample is an object of its own.
    units : {"mm", "m"}, optional
        Of arrays: the unit of all depths and sigma. Must be said where a target reaches less than 10.
    nodata : float, optional
        Of arrays: the value that depths have where no surface is, such as 65535 or NaN, in the unit of the arrays.
        A folder says it in ``submission.yaml``.
    charge_mm : float, optional
        Of arrays: what a missing or invented pixel costs in the two-sided scores, half of the rig's working range.
        Without it there are none. A dataset has a rig, which says it.

    Returns
    -------
    Result or ArrayScores
        ``metrics.object_mae_mm`` and the other scores in mm, with intervals; of a folder, the content of
        ``result.json``.

    Raises
    ------
    SubmissionError, PredictionError, DatasetError
        Naming every file with a problem, or the first sample with one.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> fpp.evaluate("predictions", "data/mini", target="depth_exact").metrics.object_mae_mm < 1.0
    True
    >>> import numpy as np
    >>> truth = np.full((2, 4, 5), 1800.0)
    >>> fpp.evaluate(truth + 2.0, truth).metrics.object_mae_mm
    2.0
    """
    in_memory = {
        "flags": flags,
        "sigma": sigma,
        "objects": objects,
        "units": units,
        "nodata": nodata,
        "charge_mm": charge_mm,
    }
    if not isinstance(predictions, (str, Path)):
        if isinstance(dataset, (str, Path, DatasetFolder)):
            raise PredictionError(
                "predictions in memory need the targets as arrays; or give a folder and a dataset"
            )
        return evaluate_arrays(predictions, dataset, **in_memory, edge_band_px=edge_band_px)
    if given := [name for name, values in in_memory.items() if values is not None]:
        raise PredictionError(
            f"{', '.join(given)}: belongs to arrays; a folder of predictions has its own"
        )
    opened = dataset if isinstance(dataset, DatasetFolder) else DatasetFolder(dataset)
    return evaluate_folder(
        predictions, opened, split, target, edge_band_px, mode, say=warnings.warn
    )


def compare(first: "str | Path | Result", second: "str | Path | Result") -> "Comparison":
    """The paired difference of two results on the same samples, with intervals over objects.

    Parameters
    ----------
    first, second : str, Path or Result
        Result files, row files of the leaderboard, or what `evaluate` gives. With a row the means of its objects are
        compared.

    Returns
    -------
    Comparison
        ``differences[key]`` in mm (second - first) and a ``sentence`` that says whether they can be told apart.

    Raises
    ------
    SubmissionError
        For results on different data or by different rules.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> one = fpp.evaluate("predictions", "data/mini")
    >>> fpp.compare(one, one).differences["object_mae_mm"].mean_mm
    0.0
    """
    from fpp_ml_bench.leaderboard.rows import alike, read_scored

    scored = (
        read_scored(Path(given)) if isinstance(given, (str, Path)) else given
        for given in (first, second)
    )
    return compare_results(*alike(*scored))


def rank(results: "Iterable[str | Path]", sort: str = "object_mae_mm") -> "list[Group]":
    """Result files as ranked groups; only results on the same data and by the same rules stand in
    one group.

    Parameters
    ----------
    results : iterable of str or Path
        Result files, or folders of them.
    sort : str
        A score, ``seconds_per_sample`` or ``frames_used``.

    Returns
    -------
    list of Group
        Each with its ``rows`` in order of rank, the tests of all ``pairs``, and ``notes`` on rows without a rank.

    Raises
    ------
    SubmissionError
        For a file that is no sound result, an unknown sort key, and a file given twice.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> fpp.rank([])
    []
    """
    from fpp_ml_bench.leaderboard import ranking

    return ranking.rank(ranking.read_entries(ranking.expand(Path(path) for path in results)), sort)
