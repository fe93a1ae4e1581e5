"""What a result was computed with: versions, the checkout's commit, a hash of the scoring source, the machine."""

import hashlib
import platform
import re
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow
import pydantic

from fpp_ml_bench import __version__, depth
from fpp_ml_bench.evaluation.result.parts import Environment, HardwareInfo
from fpp_ml_bench.machine import describe_hardware

_EVALUATION = Path(__file__).resolve().parent.parent
_COMMIT = re.compile(r"[0-9a-f]{40,64}")


def environment() -> Environment:
    """This machine and this code, for a result."""
    modules = {"numpy": np, "pyarrow": pyarrow, "pydantic": pydantic}
    return Environment(
        python=platform.python_version(),
        packages={"fpp_ml_bench": __version__, **{name: module.__version__ for name, module in modules.items()}},
        git=checkout_commit(_EVALUATION.parent),
        code_sha256=_scoring_code(),
        hardware=HardwareInfo.model_validate(describe_hardware().to_dict()),
    )


def checkout_commit(folder: Path) -> str | None:
    """The commit of the checkout in ``folder``, read from its ``.git``; None where there is none.

    No ``git`` is run: starting it would take as long as scoring several samples, and it need not be installed.
    """

    def text_of(path: Path) -> str:
        return path.read_text(encoding="utf-8").strip()

    own_folder = folder / ".git"
    try:
        if own_folder.is_file():  # a worktree: the file holds the path of its own git folder
            own_folder = folder / text_of(own_folder).removeprefix("gitdir:").strip()
        head = text_of(own_folder / "HEAD")
        if head.startswith("ref:"):
            name = head.removeprefix("ref:").strip()
            common = own_folder / "commondir"
            git_folders = [own_folder, *([own_folder / text_of(common)] if common.is_file() else [])]
            commits = [text_of(git / name) for git in git_folders if (git / name).is_file()]
            for packed in (git / "packed-refs" for git in git_folders if (git / "packed-refs").is_file()):
                lines = (line.partition(" ") for line in text_of(packed).splitlines())
                commits += [commit for commit, _, ref in lines if ref == name]
            head = commits[0] if commits else ""
    except (OSError, UnicodeDecodeError):
        return None
    return head if _COMMIT.fullmatch(head) else None


@cache
def _scoring_code() -> str:
    """SHA-256 over the source files that compute scores, 64 hex digits."""
    digest = hashlib.sha256()
    for path in (_EVALUATION / "protocol.py", *sorted((_EVALUATION / "score").glob("*.py")), Path(depth.__file__)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
