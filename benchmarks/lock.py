"""The lock file ``pylock.toml`` (PEP 751), with hashes, and ``constraints.txt`` from it.

    python benchmarks/lock.py --upgrade      today's versions of everything (pip 25.1 and newer)
    python benchmarks/lock.py                the versions that constraints.txt has
    python benchmarks/lock.py --check        exit status 1 where the two files differ

It holds what README's two lines and CI install, and the groups ``dev``, for the Python and platform
that it is run with: CI's, Python 3.11 on Linux. ``constraints.txt`` has no hashes; the pip in a new
environment of Python 3.11 reads no lock file, and README's lines use that pip. Files that pip took
from a local folder are written with their address on PyPI or PyTorch's server, by the scheme of
these; their hashes are those of the local files.
"""

import argparse
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK, CONSTRAINTS = ROOT / "pylock.toml", ROOT / "constraints.txt"
EXTRAS = "all,cluster,docs,test"
PYTORCH, PYPI = "https://download.pytorch.org/whl/cpu", "https://files.pythonhosted.org/packages"
HEAD = """\
# Written by benchmarks/lock.py from pylock.toml, which has the hashes: what CI tests, for Python 3.11.
# pip install -c constraints.txt ... takes exactly these.
"""
_LOCAL = re.compile(r'url = "file:///[^"]*/([^"/]+)"')


def address(file: str) -> str:
    """Where a wheel or source archive of this name is to be had."""
    if "%2B" in file or "+" in file:
        return f"{PYTORCH}/{file}"
    name = file.split("-")[0]
    if not file.endswith(".whl"):
        return f"{PYPI}/source/{name[0]}/{name}/{file}"
    python = file.split("-")[-3]
    return f"{PYPI}/{python}/{name[0]}/{name}/{file}"


def constraints(lock: str) -> str:
    """The content of ``constraints.txt`` that a lock file gives."""
    packages = tomllib.loads(lock)["packages"]
    pins = [f"{one['name']}=={one['version'].partition('+')[0]}" for one in packages]
    return HEAD + "".join(f"{pin}\n" for pin in sorted(pins))


def locked(upgrade: bool) -> str:
    words = [sys.executable, "-m", "pip", "lock", "-q", "-o", str(LOCK), "-e", f".[{EXTRAS}]"]
    words += ["--group", "dev", *([] if upgrade else ["-c", str(CONSTRAINTS)])]
    subprocess.run(words, cwd=ROOT, check=True)
    text = _LOCAL.sub(lambda found: f'url = "{address(found[1])}"', LOCK.read_text("utf-8"))
    head, *parts = text.split("[[packages]]\n")
    own = 'name = "fpp-ml-bench"\n'
    return "[[packages]]\n".join([head, *(part for part in parts if not part.startswith(own))])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--upgrade", action="store_true")
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    if args.check:
        same = constraints(LOCK.read_text("utf-8")) == CONSTRAINTS.read_text("utf-8")
        print("the same" if same else "constraints.txt is not that of pylock.toml")
        return int(not same)
    lock = locked(args.upgrade)
    LOCK.write_text(lock, "utf-8")
    CONSTRAINTS.write_text(constraints(lock), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
