"""The projected patterns as 8-bit images, from the codes of a rig's sequence
(`fpp_ml_bench.coding`).

The paper's: step n of the fringes of period P is ``127.5 + 127.5 cos(2 pi w / P + 2 pi n / N)``
along the varying coordinate w (paper Eq. 1), and the Gray code counts HALF periods: cell j holds
the pixels with floor(w / (P / 2)) = j, in reflected binary code, most significant bit first, 0 or
255.
"""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Code
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.containers import png_bytes
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.rig import Rig


def pattern_profile(rig: Rig, index: int) -> NDArray[np.uint8]:
    """Frame ``index`` along the coordinate it varies with, uint8: (height,) for horizontal fringes
    and code, (width,) for vertical, (1,) for black and white. Raises `RigError` for an index
    outside the sequence."""
    _check(rig, index)
    frame = rig.sequence.frames[index]
    if frame.kind == "crossed":
        raise RigError(
            f"pattern {index}: crossed fringes vary along rows and columns; they are an image, no "
            f"profile"
        )
    if frame.direction is None:
        return np.array([0 if frame.kind == "black" else GREY_LEVELS], dtype=np.uint8)
    profiles = _profiles(rig.code(frame.direction), rig.pattern_length(frame.direction))
    profile: NDArray[np.uint8] = profiles[rig.sequence.coded(frame.direction).index(index)]
    return profile


def _check(rig: Rig, index: int) -> None:
    if (
        isinstance(index, bool)
        or not isinstance(index, int | np.integer)
        or not 0 <= index < len(rig.sequence)
    ):
        raise RigError(
            f"pattern {index!r}: this rig's sequence has frames 0 to {len(rig.sequence) - 1}"
        )


@lru_cache(maxsize=8)
def _profiles(code: Code, length_px: int) -> NDArray[np.uint8]:
    profiles = code.profiles(length_px)
    profiles.setflags(write=False)
    return profiles


def pattern_profiles(rig: Rig, indices: Iterable[int] | None = None) -> NDArray[np.uint8]:
    """All F profiles, or those of ``indices``, in one table, uint8 (F, max(W, H)): row i is a
    `pattern_profile`, its last value repeated. Raises `RigError` for crossed fringes, which have
    none."""
    length = max(rig.projector.width, rig.projector.height)
    profiles = [
        pattern_profile(rig, i) for i in (range(len(rig.sequence)) if indices is None else indices)
    ]
    return np.stack([np.pad(p, (0, length - len(p)), mode="edge") for p in profiles])


def pattern_image(rig: Rig, index: int) -> NDArray[np.uint8]:
    """Frame ``index`` as the projector shows it, uint8 (h_p, w_p); read-only where it varies along
    one coordinate."""
    _check(rig, index)
    frame, (width, height) = rig.sequence.frames[index], (rig.projector.width, rig.projector.height)
    if rig.crossed is not None and frame.kind == "crossed":
        return rig.crossed.image(width, height, frame.step)
    profile = pattern_profile(rig, index)
    return np.broadcast_to(
        profile[:, None] if frame.direction == "horizontal" else profile, (height, width)
    )


def pattern_files(rig: Rig) -> dict[str, bytes]:
    """Every pattern as PNG (8-bit grey, lossless) by file name, ``A_00.png``, in frame order, which
    is that of the names."""
    digits = len(str(len(rig.sequence) - 1))
    return {
        f"A_{index:0{digits}}.png": png_bytes(pattern_image(rig, index))
        for index in range(len(rig.sequence))
    }
