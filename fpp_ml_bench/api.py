"""The front door: seven functions that open, decode, score and rank.

Like the commands, this module may import every subpackage; none of them imports it. Each function imports what it needs
when it is called.

>>> import fpp_ml_bench as fpp
>>> dataset = fpp.open_dataset("data/mini")
>>> sample = dataset.samples("test")[0]
>>> decoded = fpp.decode(dataset.frames(sample, range(52)), dataset.rig)
>>> decoded.depth_mm.shape == dataset.size
True
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fpp_ml_bench import decoding
from fpp_ml_bench.evaluation import report, result, score
from fpp_ml_bench.loaders import storage

if TYPE_CHECKING:
    import numpy as np
    from datasets import Dataset, DatasetDict
    from numpy.typing import NDArray

    from fpp_ml_bench.baselines.method import Method
    from fpp_ml_bench.leaderboard.groups import Group
    from fpp_ml_bench.optics import Rig

__all__ = ["compare", "decode", "evaluate", "load_dataset", "load_method", "open_dataset", "rank"]


def load_dataset(folder: str | Path, config: str = "single_shot", split: str | None = None) -> "Dataset | DatasetDict":
    """Open a dataset folder as a ``datasets.Dataset`` on the memory-mapped shards.

    Parameters
    ----------
    folder : str or Path
        Dataset written by ``fpp-bench build`` or ``fpp-bench import``.
    config : {"single_shot", "horizontal", "vertical", "sinusoidal", "all"}
        Which frames: the first one, those of a direction, all sinusoids, or the whole sequence.
    split : {"train", "validation", "test"}, optional
        None for all of them, as a ``DatasetDict``.

    Returns
    -------
    datasets.Dataset or datasets.DatasetDict
        Columns ``sample``, ``object``, ``view``, ``split``; a uint8 (H, W) column ``frame_NN`` for each frame;
        ``depth`` and, for generated data, ``depth_exact`` (float32 (H, W), mm, 0 = background); ``depth_min`` and
        ``depth_max`` (mm).

    Raises
    ------
    DatasetError
        For a folder that is no finished dataset, and for an unknown or unstored configuration or split.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> test = fpp.load_dataset("data/mini", "single_shot", split="test")
    >>> row = test.with_format("numpy")[0]
    >>> row["frame_00"].shape == row["depth"].shape
    True
    """
    return storage.load_dataset(folder, config, split=split)


def open_dataset(folder: str | Path) -> "storage.DatasetFolder":
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
    return storage.DatasetFolder(folder)


def load_method(name: str | Path, dataset: "storage.DatasetFolder", **options: Any) -> "Method":
    """A method that turns frames into depth, ready for a dataset's rig and image size.

    Parameters
    ----------
    name : str or Path
        ``classical``, ``phase``, ``phase-net``, shipped weights, or a ``.safetensors`` file.
    dataset : DatasetFolder
        What it is to run on; see `open_dataset`.
    **options
        The method's settings, as ``fpp-bench predict`` takes them: ``steps=4``, ``frames=3``, ``fringe="vertical"``.

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
    from fpp_ml_bench.baselines import method

    return method.load_method(name, dataset.rig, **options)


def decode(
    frames: "Sequence[NDArray[np.uint8] | None]",
    rig: "Rig",
    direction: str = "both",
    steps: int | None = None,
    mask: "NDArray[np.bool_] | None" = None,
) -> "decoding.Decoded":
    """Depth from a captured sequence: N-step phase, Gray-code order, triangulation (paper Section 2.1).

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
        ``depth_mm`` float32 (H, W), 0 where nothing was measured, and ``reasons`` (uint8 (H, W), see `Reason`).

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
    return decoding.decode_stack(frames, rig, direction, steps, mask)  # type: ignore[arg-type]


def evaluate(
    predictions: str | Path, dataset: "str | Path | storage.DatasetFolder", split: str = "test", target: str = "depth"
) -> "result.Result":
    """Score a folder of predictions, as ``fpp-eval`` does.

    Parameters
    ----------
    predictions : str or Path
        Folder with a ``submission.yaml`` and a prediction for each sample of the split.
    dataset : str, Path or DatasetFolder
        What was predicted.
    split : {"train", "validation", "test"}
        Its samples must all be there, and no others.
    target : {"depth", "depth_exact"}
        Decoded depth as in the paper, or the exact depth of generated data.

    Returns
    -------
    Result
        The content of ``result.json``: ``metrics.object_mae_mm`` and the other scores in mm, with intervals.

    Raises
    ------
    SubmissionError, PredictionError, DatasetError
        Naming every file with a problem.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> fpp.evaluate("predictions", "data/mini", target="depth_exact").metrics.object_mae_mm < 1.0
    True
    """
    opened = dataset if isinstance(dataset, storage.DatasetFolder) else storage.DatasetFolder(dataset)
    return score.evaluate(predictions, opened, split, target)


def compare(first: "str | Path | result.Result", second: "str | Path | result.Result") -> "report.Comparison":
    """The paired difference of two results on the same samples, with intervals over objects.

    Parameters
    ----------
    first, second : str, Path or Result
        Result files, or what `evaluate` gives.

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
    return report.compare(_result(first), _result(second))


def rank(results: "Iterable[str | Path]", sort: str = "object_mae_mm") -> "list[Group]":
    """Result files as ranked groups; only results on the same data and by the same rules stand in one group.

    Parameters
    ----------
    results : iterable of str or Path
        Result files, or folders of them.
    sort : str
        A score, ``seconds_per_sample`` or ``frames_used``.

    Returns
    -------
    list of Group
        Each with its ``rows`` in order of rank, the tests of all ``pairs``, and why rows have no rank (``unranked``).

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


def _result(given: "str | Path | result.Result") -> "result.Result":
    return result.read_result(Path(given)) if isinstance(given, (str, Path)) else given
