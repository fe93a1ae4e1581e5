"""Trained weights on disk: one safetensors file with the tensors and the configuration of their
network.

Its metadata are ``format`` (that of a `Family`), ``version`` and ``config``, a `ModelConfig` or
`NetConfig` as JSON. The tensors are the network's ``state_dict``. Pickles are never opened: that
can run code. The same tensors and configuration give the same bytes.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from threading import get_ident
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.depth import Normalisation, RangeRule
from fpp_ml_bench.errors import FppBenchError, NetworkError, PredictionError, WeightsError
from fpp_ml_bench.files import file_content, opened, printable, strict_json, write_atomically
from fpp_ml_bench.loaders.storage.benchmark import benchmark_of, intended_benchmark
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.options import did_you_mean
from fpp_ml_bench.schema import Count, Scalar, Text, problems_of

if TYPE_CHECKING:
    from torch import Tensor, nn

SHIPPED = Path(__file__).resolve().parent.parent / "weights"
"""Folder of the weights that come with the package, ``{name}.safetensors``."""
SUFFIX = ".safetensors"
VERSION = "1"
LARGEST_BYTES, LARGEST_HEADER_BYTES = 1 << 32, 1 << 26
"""Of a weights file, and of its header, in bytes."""
RANGE_HEADS = "range_head."
"""Tensors with this prefix are ignored: files of earlier versions hold them to make mm of
normalised depth."""

Pixels = Annotated[int, Field(gt=0)]
Fingerprint = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


@checked_dataclass(frozen=True, config=_STRICT)
class TrainingBenchmark:
    """``name`` and ``version`` of the benchmark (`loaders.storage.benchmark`) that a network was
    trained on."""

    name: Text
    version: Count

    @property
    def title(self) -> str:
        return f"{self.name} version {self.version}"


@checked_dataclass(frozen=True, config=_STRICT, kw_only=True)
class TrainedConfig:
    """What a trained network is, and what it was trained on. ``ValueError`` for a wrong type or
    unknown value.

    ``options``: arguments that build it again; ``benchmark`` is None for a dataset of the user's
    own, and in older files; ``recipe``: the resolved recipe; ``validation``: the scores of these
    weights."""

    name: Text
    title: Text
    options: dict[Text, Any]
    dataset_fingerprint: Fingerprint
    benchmark: TrainingBenchmark | None = None
    recipe: dict[Text, Any] = field(default_factory=dict)
    validation: dict[Text, Scalar] = field(default_factory=dict)


@checked_dataclass(frozen=True, config=_STRICT, kw_only=True)
class ModelConfig(TrainedConfig):
    """A network from image to depth. ``network`` and ``options`` are what ``networks.build`` takes;
    ``normalisation`` is what it puts out, ``image_size`` (H, W) in px the only size it is meant
    for. ``data_config`` names the frames it was trained on, ``background_removed`` says that its
    input is 0 outside the object, ``range_rule`` by which depth range it was normalised (``object``
    in older files)."""

    network: Text
    normalisation: Normalisation
    image_size: tuple[Pixels, Pixels]
    data_config: Text = "single_shot"
    background_removed: bool = False
    range_rule: RangeRule = "object"
    epoch: Count = 0

    def __post_init__(self) -> None:
        if self.data_config not in CONFIGS:
            raise ValueError(
                f"unknown data_config {self.data_config!r}; there are {', '.join(CONFIGS)}"
            )


@checked_dataclass(frozen=True, config=_STRICT, kw_only=True)
class NetConfig(TrainedConfig):
    """A network of fringe-net. ``steps`` trained."""

    steps: Count = 0


@dataclass(frozen=True)
class Family:
    """A kind of networks: ``format`` and configuration of their files, the ``recipe`` that
    ``fpp-bench train`` is given for them, and what builds the network of a configuration. ``half``:
    that files hold half precision."""

    format: str
    config: TypeAdapter[Any]
    recipe: str
    build: Callable[[Any], Any]
    half: bool = True


def _depth_network(config: ModelConfig) -> "nn.Module":
    from fpp_ml_bench.baselines.networks.model import build  # imports this module

    network = build(config.network, **config.options)
    network.check_size(*config.image_size)
    return network


def _fringe_network(config: NetConfig) -> "nn.Module":
    from fpp_ml_bench.baselines.learned.network import FringeNet  # imports this module

    return FringeNet(**config.options)


DEPTH_NETWORKS = Family(
    "fpp-ml-bench", TypeAdapter(ModelConfig), "RECIPE", _depth_network, half=False
)
FRINGE_NETWORKS = Family(
    "fpp-ml-bench fringe-net", TypeAdapter(NetConfig), "fringe-net", _fringe_network
)


@dataclass(frozen=True)
class WeightsFile:
    """A checked file: its ``network`` in float32, in eval mode."""

    path: Path
    config: Any
    network: Any
    sha256: str


def save_weights(
    path: str | Path,
    network: "nn.Module",
    config: TrainedConfig,
    family: Family = DEPTH_NETWORKS,
) -> str:
    """Write ``network`` (its ``state_dict``) to ``path``, complete or not at all; the file's
    SHA-256. Raises `WeightsError` for tensors that are not finite, that do not fit the network that
    ``config`` builds, and for a path that can't be written."""
    path = Path(path)
    if path.suffix != SUFFIX:
        raise _fault(
            path, f": expected a name that ends in {SUFFIX}; weights are saved as nothing else"
        )
    tensors = network.state_dict()
    _built(path, config, tensors, family)
    if family.half:
        tensors = {
            name: tensor.half() if tensor.is_floating_point() else tensor
            for name, tensor in tensors.items()
        }
    _check_finite(path, tensors)
    data = file_bytes(family, config, tensors)
    try:
        write_atomically(path, data)
    except OSError as error:
        raise _fault(
            path, f" can't be written: {error.strerror}; give a folder that exists"
        ) from None
    return sha256(data).hexdigest()


def open_weights(path: str | Path, family: Family = DEPTH_NETWORKS) -> WeightsFile:
    """Everything in a weights file of ``family``, checked. `WeightsError` as `read_file`, and for
    tensors that are not finite or that do not fit the network that the configuration builds."""
    path = Path(path)
    config, stored, digest = read_file(path, family)
    tensors = {name: tensor for name, tensor in stored.items() if not name.startswith(RANGE_HEADS)}
    _check_finite(path, tensors)
    if family.half:
        tensors = {
            name: tensor.float() if tensor.is_floating_point() else tensor
            for name, tensor in tensors.items()
        }
    network = _built(path, config, tensors, family)
    network.load_state_dict(tensors, assign=True)
    return WeightsFile(path, config, network.eval(), digest)


def shipped_names(folder: Path | None = None) -> list[str]:
    """Names of the weights in ``folder``, by default the networks that come with the package,
    sorted."""
    return sorted(path.name.removesuffix(SUFFIX) for path in (folder or SHIPPED).glob(f"*{SUFFIX}"))


def weights_path(name_or_path: str | Path, folder: Path | None = None) -> Path:
    """Path of the file that ``name_or_path`` means: a path if it ends in ``.safetensors`` or
    exists, else the name of weights in ``folder`` (None: `SHIPPED`). Raises `WeightsError` for an
    unknown name and lists the known ones."""
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(SUFFIX) or "/" in text or "\\" in text:
        return Path(name_or_path)
    if text in (names := shipped_names(folder)):
        return (folder or SHIPPED) / f"{text}{SUFFIX}"
    if Path(text).exists():
        return Path(text)
    raise WeightsError(
        f"no weights called {printable(text, 100)!r} come with this package; "
        f"{did_you_mean(text, names)}; or give the "
        f"path of a {SUFFIX} file"
    )


def training_benchmark(content: Mapping[str, str]) -> TrainingBenchmark | None:
    """The named benchmark with this content (`Manifest.content`), for the weights file; None for
    any other dataset."""
    benchmark = benchmark_of(content)
    return None if benchmark is None else TrainingBenchmark(benchmark.name, benchmark.version)


def training_data_warning(config: TrainedConfig, manifest: Manifest) -> str | None:
    """A sentence where weights are used on another version of the benchmark that they were trained
    on, or where nothing is known about their training data; else None. Only for a named benchmark,
    or a dataset built with its settings: on imported data, a dataset with settings of its own and
    another benchmark the user chose so."""
    used_on, training = training_benchmark(manifest.content), config.benchmark
    named = used_on or intended_benchmark(manifest)
    if named is None or config.dataset_fingerprint == manifest.fingerprint:
        return None
    if training is not None and (training.name != named.name or training == used_on):
        return None
    training_data = (
        f"dataset {config.dataset_fingerprint[:8]}, which is no benchmark of this version"
    )
    dataset = (
        f"dataset {manifest.fingerprint[:8]}, which has the settings of {named.title} but other "
        f"content"
    )
    return (
        f"trained on {training_data if training is None else training.title}; predicting on "
        f"{dataset if used_on is None else used_on.title}"
    )


def file_bytes(family: Family, config: Any, tensors: "Mapping[str, Tensor]") -> bytes:
    """A file of ``family``: always the same bytes for the same ``tensors`` and ``config``."""
    from safetensors.torch import save

    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    text = family.config.dump_json(config).decode("utf-8")
    data = save(plain, {"format": family.format, "version": VERSION, "config": text})
    # safetensors writes the metadata's keys in an order that changes from run to run.
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length].decode("utf-8"))
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    encoded = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode("utf-8")
    encoded += b" " * (-len(encoded) % 8)  # tensors start aligned
    return len(encoded).to_bytes(8, "little") + encoded + data[8 + length :]


def read_file(path: Path, family: Family) -> "tuple[Any, dict[str, Tensor], str]":
    """The checked configuration, the tensors as they are, and the SHA-256 of a file of ``family``.
    Raises `WeightsError`, naming file, expectation, finding and cure, for a file that is absent,
    damaged, a pickle or of another kind or version, or has unknown or missing keys in its
    configuration."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    if not path.is_file():
        actual = "a folder" if path.is_dir() else "no file" if path.exists() else "nothing"
        raise _fault(path, f": expected a weights file (*{SUFFIX}), found {actual} there")
    metadata = _header(path)
    form, version = (printable(metadata.get(key), 60) for key in ("format", "version"))
    if metadata.get("format") != family.format:
        cure = f"give what fpp-bench train {family.recipe} wrote"
        raise _fault(path, f": expected weights of {family.format}, got format {form!r}; {cure}")
    if metadata.get("version") != VERSION:
        cure = "read it with the version of fpp-ml-bench that wrote it, or train again"
        raise _fault(path, f": expected version {VERSION}, got {version!r}; {cure}")
    data = file_content(path, LARGEST_BYTES, WeightsError, "give a weights file")
    try:
        text = metadata.get("config", "")
        strict_json(text)
        tensors, config = load(data), family.config.validate_json(text)
    except ValueError as error:
        lines = "\n  ".join(
            problems_of(error) if isinstance(error, ValidationError) else [str(error)]
        )
        raise _fault(
            path, f": its configuration is not valid; train or save it again:\n  {lines}"
        ) from None
    except (SafetensorError, KeyError, RuntimeError, TypeError) as error:
        raise _fault(
            path, f": damaged ({printable(str(error), 200)}); copy or train it again"
        ) from None
    return config, tensors, sha256(data).hexdigest()


def _header(path: Path) -> dict[str, Any]:
    """The metadata in a file's header, which is read and compared with the file's size before
    anything else."""
    try:
        with opened(path, links=True) as (stream, size):
            start = stream.read(8)
            length = int.from_bytes(start, "little")
            header = stream.read(min(length, LARGEST_HEADER_BYTES))
    except PredictionError as error:
        raise _fault(path, f": {error}") from None
    if start[:4] == b"PK\x03\x04" or (
        start[:1] == b"\x80" and start[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05")
    ):
        raise _fault(
            path,
            f": expected {SUFFIX}, got a PyTorch pickle (.pt, .pth), which is never opened, "
            f"because a pickle can "
            "run code; load it where you trust it and write it with "
            "fpp_ml_bench.baselines.training.weights.save_weights",
        )
    try:
        if len(start) < 8 or len(header) < length:
            raise ValueError(f"a header of {length} bytes, found {len(header)}")
        described = strict_json(header.decode("utf-8"))
        metadata = described.pop("__metadata__", {})
        stated_size = (
            8 + length + max((entry["data_offsets"][1] for entry in described.values()), default=0)
        )
        if stated_size != size or not isinstance(metadata, dict):
            raise ValueError(f"its header tells of {stated_size} bytes, it has {size}")
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise _fault(
            path,
            f": damaged or no {SUFFIX} file ({printable(str(error), 200)}); copy or train it again",
        ) from None
    return metadata


def _built(path: Path, config: Any, tensors: "Mapping[str, Tensor]", family: Family) -> "nn.Module":
    """The network that ``config`` makes, without memory. Refuses tensors that are not exactly its
    own."""
    import torch
    from torch.nn.modules.module import register_module_parameter_registration_hook
    from torch.overrides import TorchFunctionMode

    class Undrawn(TorchFunctionMode):
        """Draws no first weights: on "meta", which has no values, torch would import its compiler
        for that: 0.8 s."""

        def __torch_function__(
            self, func: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            if func.__name__ in ("normal_", "uniform_"):
                return args[0] if args else kwargs["tensor"]
            return func(*args, **(kwargs or {}))

    parameters, thread = 0, get_ident()

    def count(*parameter: object) -> None:
        """Ends the building of a network that can't be that of the file: of a million levels,
        say."""
        nonlocal parameters
        parameters += get_ident() == thread
        if parameters > 2 * len(tensors):
            raise NetworkError(
                f"more than twice as many parameters as the file has tensors, {len(tensors)}"
            )

    counting = register_module_parameter_registration_hook(count)
    try:
        with torch.device("meta"), Undrawn():
            network = family.build(config)
        expected = network.state_dict()
    except (FppBenchError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _fault(
            path, f": its configuration makes no network: {printable(str(error), 300)}"
        ) from None
    finally:
        counting.remove()
    options = ", ".join(f"{key}={value}" for key, value in config.options.items()) or "its defaults"
    built = f"{getattr(config, 'network', family.recipe)} with {printable(options, 200)}"
    for name in tensors:
        if name not in expected:
            raise _fault(path, f": tensor {printable(name, 100)} is none of {built}")
    for name, tensor in expected.items():
        if name not in tensors:
            raise _fault(
                path, f": tensor {name} is missing, which {built} has; train or copy it again"
            )
        wanted, actual = (
            f"{str(t.dtype).removeprefix('torch.')} {tuple(t.shape)}"
            for t in (tensor, tensors[name])
        )
        if actual != wanted:
            raise _fault(path, f": tensor {name}: expected {wanted} for {built}, got {actual}")
    return network


def _check_finite(path: Path, tensors: "Mapping[str, Tensor]") -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            words = "holds values that are not finite; the training diverged or the file is damaged"
            raise _fault(path, f": tensor {printable(name, 100)} {words}")


def _fault(path: Path, words: str) -> WeightsError:
    return WeightsError(f"{printable(path)}{words}")
