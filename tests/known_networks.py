"""Networks whose answer is known, as subjects of a diagnosis."""

import numpy as np
import torch
from torch import nn

from fpp_ml_bench.baselines.diagnostics.scenes import truth
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.baselines.method import Answer


class Oracle(nn.Module):
    """A network that knows the truth of the samples it is shown: its layer ``out`` holds the maps
    it was given."""

    def __init__(self, maps: dict[float, torch.Tensor]) -> None:
        super().__init__()
        self.out = nn.Identity()
        self.maps = maps

    def forward(self, fringe: torch.Tensor) -> torch.Tensor:
        maps = torch.stack([self.maps[float(image.detach().double().sum())] for image in fringe])
        return self.out(maps + 0 * fringe).mean(1, keepdim=True)


def subject_with(network: nn.Module, size, layers=("out",)) -> Subject:
    """A subject around ``network``, whose ``layers`` are its children."""
    return Subject(
        name="known",
        title="known",
        sha256="0" * 64,
        units="normalised",
        image_size=size,
        frames_used=(0,),
        direction="horizontal",
        answer=lambda frames: Answer(np.zeros(size, np.float32)),
        normalisation="individual",
        network=network,
        layer_names=layers,
        untrained=lambda seed: network,
    )


def oracle(opened, fields):
    """An `Oracle` of the maps ``fields`` of `truth`, as a subject."""
    maps = {}
    for sample in opened.samples("all"):
        ground_truth = truth(opened.depth_mm(sample), opened.rig, "horizontal")
        key = subject_with(nn.Identity(), opened.size).input_batch([[opened.frame(sample, 0)]])[0]
        maps[float(key.double().sum())] = torch.from_numpy(
            np.stack([ground_truth[name] for name in fields])
        )
    return subject_with(Oracle(maps), opened.size)
