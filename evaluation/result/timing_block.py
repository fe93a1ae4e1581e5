"""Run time as part of a submission: the ``timing`` block of ``submission.yaml`` and ``result.json``.

``fpp-bench time`` writes it with provenance ``measured``; times from elsewhere have provenance ``self-reported``.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fpp_ml_bench.evaluation.schema import Count, NonNegative, Positive, StrictModel, Text

Whole = Annotated[int, Field(gt=0)]


class HardwareInfo(StrictModel):
    """The machine a time was measured on, as `fpp_ml_bench.machine.describe_hardware` puts it."""

    cpu: Text
    cores: Count
    memory_gib: NonNegative
    gpu: Text | None
    platform: Text


class Timing(StrictModel):
    """How long a method takes on images of ``image_size`` (H, W) px, and what it needs.

    Latency is that of one image at batch 1 after warm-up, frames in memory: the median, 5th and 95th percentile over
    ``repeats`` runs, in ms. Throughput is in images per second with ``batch`` images at once (``batched`` says whether
    the method takes them together or one after another). ``peak_memory_mib`` is the largest resident set of the whole
    process, ``working_memory_mib`` what predicting one image adds to it, ``gpu_memory_mib`` the most that was allocated
    on the GPU; null where unknown. ``frames`` is the number of captures that one depth map costs.
    """

    provenance: Literal["measured", "self-reported"]
    latency_median_ms: Positive
    latency_p5_ms: Positive
    latency_p95_ms: Positive
    repeats: Whole
    batch: Whole
    batched: bool
    throughput_per_s: Positive
    peak_memory_mib: NonNegative | None
    working_memory_mib: NonNegative | None
    gpu_memory_mib: NonNegative | None
    parameters: Count
    frames: Count
    image_size: Annotated[list[Whole], Field(min_length=2, max_length=2)]
    device: Text
    hardware: HardwareInfo
    software: dict[Text, Text] = Field(default_factory=dict, max_length=100)

    @model_validator(mode="after")
    def _ordered(self) -> "Timing":
        if not self.latency_p5_ms <= self.latency_median_ms <= self.latency_p95_ms:
            raise ValueError("expected latency_p5_ms <= latency_median_ms <= latency_p95_ms")
        return self
