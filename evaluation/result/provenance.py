"""What a result was computed with: versions, the checkout's commit, a hash of the scoring source, the machine."""

import hashlib
import platform
import re
from functools import cache
from pathlib import Path

import numpy as np

from fpp_ml_bench import __version__, depth
from fpp_ml_bench.evaluation.result.parts import Environment
from fpp_ml_bench.evaluation.result.timing_block import HardwareInfo
from fpp_ml_bench.machine import describe_hardware

_EVALUATION = Path(__file__).resolve().parent.parent
_COMMIT = re.compile(r"[0-9a-f]{40,64}")


def environment() -> Environment:
    """This machine and this code, for a result."""
    import pyarrow
    from pydantic import VERSION

    packages = {"fpp_ml_bench": __version__, "numpy": np.__version__, "pyarrow": pyarrow.__version__,
                "pydantic": VERSION}  # fmt: skip
    return Environment(
        python=platform.python_version(),
        packages=packages,
        git=checkout_commit(_EVALUATION.parent),
        code_sha256=scoring_code(),
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
    )


def checkout_commit(folder: Path) -> str | None:
    """The commit of the checkout in ``folder``, read from its ``.git``; None where there is none.

    No ``git`` is run: starting it would take as long as scoring several samples, and it need not be installed.
    """
    own_folder = folder / ".git"
    try:
        if own_folder.is_file():  # a worktree: the file holds the path of its own git folder
            own_folder = folder / own_folder.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
        head = (own_folder / "HEAD").read_text(encoding="utf-8").strip()
        if not head.startswith("ref:"):
            return head if _COMMIT.fullmatch(head) else None
        name = head.removeprefix("ref:").strip()
        common = own_folder / "commondir"
        git_folders = [own_folder] + (
            [own_folder / common.read_text(encoding="utf-8").strip()] if common.is_file() else []
        )
        for git_folder in git_folders:
            if (git_folder / name).is_file():
                commit = (git_folder / name).read_text(encoding="utf-8").strip()
                return commit if _COMMIT.fullmatch(commit) else None
        for git_folder in git_folders:
            if (git_folder / "packed-refs").is_file():
                for line in (git_folder / "packed-refs").read_text(encoding="utf-8").splitlines():
                    commit, _, ref = line.partition(" ")
                    if ref == name and _COMMIT.fullmatch(commit):
                        return commit
    except (OSError, UnicodeDecodeError):
        return None
    return None


@cache
def scoring_code() -> str:
    """SHA-256 over the source files that compute scores, 64 hex digits."""
    digest = hashlib.sha256()
    for path in (_EVALUATION / "protocol.py", *sorted((_EVALUATION / "score").glob("*.py")), Path(depth.__file__)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
