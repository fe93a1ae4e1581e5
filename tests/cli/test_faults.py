"""Long work under faults: two at once, a broken cache of machine code, full disks, files that are
cut while they are read, outputs that nobody reads, and SIGTERM."""

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import xxhash
from conftest import TINY_SIZE, fpp_bench, fpp_eval, refusal, tiny_settings
from disks import small_disk
from scored_dataset import make_dataset

from fpp_ml_bench import files, pool
from fpp_ml_bench.baselines.learned.recipe import FringeRecipe
from fpp_ml_bench.baselines.learned.training import train_net
from fpp_ml_bench.baselines.training.engine import CHECKPOINT, alone_in, save_checkpoint
from fpp_ml_bench.cli import run_command
from fpp_ml_bench.cli.console import progress_bar
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.errors import BuildError, DatasetError, PoolError, RemoteError, TrainingError
from fpp_ml_bench.files import (
    LOCK_FILE,
    exclusive,
    file_hash,
    printable,
    whole_file,
    whole_folder,
    write_atomically,
)
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.storage import assembly
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.remote import RemoteFolder

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "fpp_ml_bench"]
FREE_SPACE = "free some space or choose another disk"


def predict(dataset, out):
    return fpp_bench("predict constant", dataset, "--out", out)


# ---- two at once


def test_of_two_that_predict_into_a_folder_one_is_told(tiny, tmp_path):
    out = tmp_path / "out"
    with exclusive(out / LOCK_FILE, out, "here"):
        said = refusal(predict, tiny, out)
    assert f"{out}: another process is predicting into this folder; wait for it or" in said
    assert predict(tiny, out) == 0
    assert not (out / LOCK_FILE).exists() and fpp_eval("check", out) == 0


def test_what_a_killed_run_left_locks_nothing_and_the_evaluator_says_what_it_is(
    tiny, tmp_path, capsys
):
    out = tmp_path / "out"
    out.mkdir()
    for name in (LOCK_FILE, ".power_drill_A0.npy.123.tmp", "unfinished.jsonl"):
        (out / name).write_text("")
    fpp_eval(out, tiny)
    problems = capsys.readouterr().err
    assert (
        "unfinished.jsonl: is extra (a stopped fpp-bench predict left it: run the same command "
        "again" in problems
    )
    assert LOCK_FILE not in problems
    assert predict(tiny, out) == 0
    assert fpp_eval(out, tiny) == 0


def test_of_two_that_train_in_a_folder_one_is_told(tmp_path):
    out = tmp_path / "run"
    with (
        alone_in(out),
        pytest.raises(
            TrainingError, match="another process is training in this folder; wait for it"
        ),
    ):
        train_net(FringeRecipe(), out)
    assert not out.exists()  # the lock made it, and nothing was written there


def test_a_lock_of_a_folder_that_was_moved_away_is_not_that_of_the_next(tmp_path):
    with exclusive(tmp_path / "a" / LOCK_FILE, tmp_path, "here"):
        (tmp_path / "a").rename(tmp_path / "b")
        with exclusive(tmp_path / "a" / LOCK_FILE, tmp_path, "here"):
            (tmp_path / "a" / "kept").write_text("")
        (tmp_path / "a" / LOCK_FILE).write_text("")
    assert (tmp_path / "a" / LOCK_FILE).exists()


# ---- machine code on disk

_KERNEL = """
from fpp_ml_bench.machine import njit

@njit
def total(values):
    result = 0.0
    for k in range(values.size):
        result += values[k] * values[k]
    return result
"""
_DAMAGED = """
import importlib, os, shutil, sys
from pathlib import Path
import numpy as np
import kernel

def loaded():
    importlib.reload(kernel)
    assert kernel.total(np.arange(100.0)) == 328350.0
    return sum(kernel.total.stats.cache_hits.values())

assert loaded() == 1, "kept by the first import"
index, code = (next(Path("code").rglob(f"*.{suffix}")) for suffix in ("nbi", "nbc"))
damages = {
    "an empty index": lambda: index.write_bytes(b""),
    "a foreign index": lambda: index.write_bytes(os.urandom(500)),
    "an index of another version": lambda: index.write_bytes(index.read_bytes().replace(kernel.VERSION, b"0" * 6, 1)),
    "code that is cut": lambda: code.write_bytes(code.read_bytes()[:-500]),
    "foreign code": lambda: code.write_bytes(os.urandom(5000)),
    "zeros in the code": lambda: code.write_bytes(code.read_bytes()[:4200] + bytes(200) + code.read_bytes()[4400:]),
    "no code": lambda: code.unlink(),
}
for what, damage in damages.items():
    damage()
    assert (loaded(), loaded()) == (0, 1), what
index.unlink()
index.mkdir()
assert (loaded(), loaded()) == (0, 0), "can't be read or written"
print("sound")
"""


@pytest.mark.processes
def test_a_broken_cache_of_machine_code_is_made_again_or_gone_without(tmp_path):
    (tmp_path / "kernel.py").write_text(
        "import numba\nimport numpy as np\nVERSION = numba.__version__.encode()[:6]\n"
        + _KERNEL
        + "total(np.arange(100.0))\n"
    )
    done = _python(_DAMAGED, tmp_path, NUMBA_CACHE_DIR="code")
    assert done.stdout == "sound\n", done.stderr


@pytest.mark.processes
def test_a_full_or_unusable_cache_folder_is_gone_without(tmp_path):
    (tmp_path / "kernel.py").write_text(_KERNEL)
    (tmp_path / "file").write_text("")
    use = "import kernel, numpy as np\nprint(kernel.total(np.arange(3.0)))"
    assert _python(use, tmp_path, NUMBA_CACHE_DIR="file").stdout == "5.0\n"
    limited = (
        f"import resource, signal\nresource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n{use}"
    )
    assert _python(limited, tmp_path, NUMBA_CACHE_DIR="code").stdout == "5.0\n"
    assert not list((tmp_path / "code").rglob("*.nbc"))


def _python(code, folder, **environment):
    path = os.pathsep.join((str(folder), str(ROOT)))
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path, **environment},
    )


# ---- full disks


@contextmanager
def files_of_at_most(count):
    """Within: a file that grows beyond so many bytes meets EFBIG, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_full_disks_are_answered_with_file_and_cure(tiny, tmp_path):
    predictions, again = tmp_path / "predictions", tmp_path / "again"
    assert predict(tiny, predictions) == 0
    score = f"{predictions} {tiny} --json {tmp_path}/result.json"
    board = f"calibrate --virtual {tmp_path}/v --size 256 --poses 4 --out {tmp_path}/rig.yaml"
    for run, line, name in (
        (fpp_bench, f"predict constant {tiny} --out {again}", "again/unfinished.jsonl"),
        (fpp_eval, score, "result.json"),
        (fpp_bench, board, "/v: "),
    ):
        with files_of_at_most(100):
            message = refusal(run, line).splitlines()[-1]
        assert name in message and FREE_SPACE in message and "Errno" not in message, message
    assert fpp_eval(score) == 0 and predict(tiny, again) == 0  # nothing is in the way


@pytest.mark.processes
def test_a_prediction_goes_on_after_a_really_full_disk(tiny, tmp_path):
    with small_disk(tmp_path / "disk", "300k") as disk:
        message = refusal(predict, tiny, disk / "out")
        assert f"{disk / 'out'}/" in message and f"No space left on device; {FREE_SPACE}" in message
        assert (disk / "out" / "unfinished.jsonl").exists()
        subprocess.run(["mount", "-o", "remount,size=2m", str(disk)], check=True)
        assert predict(tiny, disk / "out") == 0
        assert fpp_eval("check", disk / "out") == 0


def test_a_training_names_the_file_that_does_not_fit(tmp_path):
    with files_of_at_most(1000), pytest.raises(OSError, match=FREE_SPACE) as full:
        save_checkpoint(tmp_path / CHECKPOINT, {"weights": torch.zeros(1000)}, {})
    assert full.value.filename == str(tmp_path / CHECKPOINT) and not list(tmp_path.iterdir())


def test_errors_of_the_system_come_without_numbers(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    with pytest.raises(RemoteError) as refused:
        RemoteFolder((tmp_path / "file").as_uri()).put(tmp_path / "file", "a/b.bin")
    assert "Errno" not in str(refused.value)

    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/some/file")

    monkeypatch.setattr(assembly, "_check_settings", full)
    with pytest.raises(
        DatasetError,
        match=r"^/some/file: writing failed \(No space left on device\); remove the cause",
    ):
        build(tmp_path / "set", tiny_settings(), workers=1)


# ---- files that are cut while they are read


def test_a_shard_that_is_cut_while_it_is_open_is_named(tmp_path):
    opened = make_dataset(tmp_path / "set")
    sample = opened.samples("test")[0]
    opened.frame(sample, 0)
    shard = next(shard for shard in opened.manifest.shards if shard.split == "test")
    os.truncate(opened.path / shard.path, 4096)
    with pytest.raises(
        DatasetError, match=rf"{shard.path}: was cut to 4096 bytes while it was read"
    ):
        opened.depth_mm(sample)
    with pytest.raises(
        DatasetError, match=rf"{shard.path}: has 4096 bytes, expected {shard.bytes}"
    ):
        DatasetFolder(opened.path)


def test_a_file_that_is_cut_while_it_is_hashed_has_another_hash(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_bytes(b"")
    os.truncate(file, 40_000_000)
    whole, digest = file_hash(file), xxhash.xxh3_128

    class Cutting:
        def __init__(self):
            self.digest = digest()

        def update(self, content):
            self.digest.update(content)
            os.truncate(file, 4096)

        def hexdigest(self):
            return self.digest.hexdigest()

    monkeypatch.setattr(xxhash, "xxh3_128", Cutting)
    assert file_hash(file) != whole


# ---- names of temporary files


def test_no_planted_link_is_followed(tmp_path, monkeypatch):
    """Even where the name is guessed."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    monkeypatch.setattr(files, "token_hex", lambda count: "0" * 16)
    for plant in (os.symlink, os.link):
        plant(victim, tmp_path / f".{'0' * 16}.tmp")
        with pytest.raises(FileExistsError):
            write_atomically(tmp_path / "result.json", b"other")
        assert victim.read_text() == "precious" and not (tmp_path / "result.json").exists()
    monkeypatch.undo()
    (tmp_path / "result.json").symlink_to(victim)
    write_atomically(tmp_path / "result.json", b"other")
    assert victim.read_text() == "precious" and not (tmp_path / "result.json").is_symlink()
    with pytest.raises(RuntimeError), whole_file(tmp_path / "half") as file:
        assert re.fullmatch(files.UNFINISHED, Path(file.name).name)
        raise RuntimeError
    assert {path.name for path in tmp_path.iterdir()} == {"victim", "result.json"}


def test_a_folder_that_is_made_whole_does_not_begin_in_a_link(tmp_path):
    (tmp_path / "elsewhere" / "files").mkdir(parents=True)
    (tmp_path / "elsewhere" / "files" / "kept").write_text("")
    (tmp_path / ".out.unfinished").symlink_to("elsewhere")
    with (
        pytest.raises(BuildError, match="is a link"),
        whole_folder(tmp_path / "out", "here", BuildError),
    ):
        pass
    assert (tmp_path / "elsewhere" / "files" / "kept").exists()


# ---- memory, names that steer a terminal


def test_too_little_memory_is_a_message(capsys):
    for error in (MemoryError(), MemoryError("Unable to allocate 3 GiB")):
        assert run_command(Mock(side_effect=error), "fpp-bench x", []) == 2
    library = ImportError("libarrow.so: failed to map segment from shared object")
    assert run_command(Mock(side_effect=library), "fpp-bench x", []) == 2
    with pytest.raises(ImportError, match="cannot import name"):
        run_command(Mock(side_effect=ImportError("cannot import name 'x'")), "fpp-bench x", [])
    said = capsys.readouterr().err
    assert "a library can't be loaded (libarrow.so: failed" in said
    assert (
        "there is not enough memory;" in said
        and "memory (Unable to allocate 3 GiB); allow more" in said
    )


def test_what_would_steer_the_terminal_is_escaped_in_an_error(tmp_path):
    said = refusal(fpp_bench, f"info {tmp_path}/a\x1b[31m\x07b")
    assert "\x1b" not in said and "a\\x1b[31m\\x07b" in said


@pytest.mark.parametrize("name", ["[red]", "\x1b[2J", "é" * 300])
def test_a_name_is_no_markup_of_a_progress_bar(name, capsys):
    with progress_bar(name, 2, "samples") as advance:
        advance(2)
    said = capsys.readouterr().err
    assert "\x1b[2J" not in said
    if len(name) < 10:
        assert printable(name) in said


# ---- shared memory


def test_without_shared_memory_there_is_a_message(monkeypatch):
    def read_only(*arguments, **options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(pool, "ProcessPoolExecutor", read_only)
    message = (
        r"shared memory \(/dev/shm\) can't be used \(Read-only file system\).* or give --workers 1"
    )
    with pytest.raises(PoolError, match=message), pool.mapping(None, 2):
        pass


# ---- outputs that nobody reads


def _shell(redirection, words, **environment):
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    return subprocess.run(
        ["bash", "-c", f'set -o pipefail; "$@" {redirection}', "bash", *COMMAND, *words],
        cwd=ROOT,
        text=True,
        capture_output=True,
        env={**kept, **environment},
    )


@pytest.mark.processes
@pytest.mark.parametrize("environment", [{}, {"PYTHONUNBUFFERED": "1"}])
def test_an_output_that_nobody_reads(tiny, environment):
    for redirection, status in ((">&-", 0), (">&- 2>&-", 0), ("| sleep 0", 141)):
        done = _shell(redirection, ["info", str(tiny)], **environment)
        assert (done.returncode, done.stdout, done.stderr) == (status, "", ""), redirection


@pytest.mark.processes
def test_an_output_that_can_not_be_written(tiny):
    for words in (["info", str(tiny)], ["--help"]):
        done = _shell(">/dev/full", words)
        assert done.returncode == 2 and done.stderr.count("\n") == 1
        assert "error: standard output" in done.stderr and "No space left on device" in done.stderr


@pytest.mark.long
def test_everything_is_written_before_a_table_that_nobody_reads(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.cli.console.show", Mock(side_effect=BrokenPipeError))
    assert predict(tiny, tmp_path / "predictions") == 0
    assert fpp_eval(f"{tmp_path}/predictions {tiny} --report {tmp_path}/report") == 141
    assert (tmp_path / "report" / "index.html").exists()


# ---- SIGTERM


def test_sigterm_ends_a_command_as_ctrl_c_does(capsys, tmp_path):
    @command("")
    def run() -> None:
        """Stop."""
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # `timeout` sends a second
            write_atomically(tmp_path / "saved", b"x")

    before = signal.getsignal(signal.SIGTERM)
    assert run_command(lambda: run, "fpp-bench x", []) == 143
    assert capsys.readouterr().err == "fpp-bench x: stopped\n"
    assert (tmp_path / "saved").exists() and signal.getsignal(signal.SIGTERM) == before


@pytest.mark.processes
def test_sigterm_during_an_import_is_not_swallowed(tmp_path):
    swallows = (
        "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGTERM)\nexcept "
        "BaseException:\n    pass\n"
    )
    (tmp_path / "swallows.py").write_text(swallows)
    code = (
        "from fpp_ml_bench.cli import run_command\n"
        "from fpp_ml_bench.cli.options import command\n"
        "@command('')\ndef stopped():\n    import swallows\n"
        "run_command(lambda: stopped, 'x', [])"
    )
    done = _python(code, tmp_path)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")


@pytest.mark.processes
def test_a_prediction_that_is_terminated_resumes(tiny, tmp_path):
    out = tmp_path / "out"
    line = f"predict classical {tiny} --split all --out {out}"
    words = [*COMMAND, *line.split()]
    process = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    while not list(out.glob("*.npy")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)
    process.terminate()
    errors = process.communicate(timeout=60)[1]
    assert process.returncode == 143 and "Traceback" not in errors
    assert errors.endswith("fpp-bench predict: stopped; the same command continues\n")
    assert (out / "unfinished.jsonl").exists() and not (out / LOCK_FILE).exists()
    assert not list(out.glob(".*.tmp"))
    assert fpp_bench(line) == 0
    assert np.load(next(out.glob("*.npy"))).shape == (TINY_SIZE, TINY_SIZE)
