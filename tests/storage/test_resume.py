"""Crash safety, with real processes, real signals and a really full disk: no partial result, the
same bytes at last."""

import contextlib
import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from conftest import (
    TINY_OBJECTS,
    TINY_SIZE,
    file_bytes,
    flip,
    fpp_bench,
    printed,
    refusal,
    tiny_settings,
)
from disks import small_disk

from fpp_ml_bench.errors import BuildError, DatasetError, PoolError
from fpp_ml_bench.loaders.render.builder import assembly_of, build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.storage.assembly import Assembly, assemble
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify

ROOT = Path(__file__).resolve().parent.parent
COMMAND = [sys.executable, "-c", "import sys; from fpp_ml_bench.cli import main; sys.exit(main())"]
DIRECT = named_light("paper").changed("bounces", interreflection=False, ambient_occlusion=False)
"""Light without bounces, which is quick to compute."""
SMALL = {"objects": ("cork",), "stored": "single_shot"}


def build_line(folder, objects=TINY_OBJECTS, workers=1):
    words = f"--out {folder} --size {TINY_SIZE} --workers {workers}"
    return f"build {words} --objects {','.join(objects)}"


def half_line(folder, light):
    """Of the dataset of `half_settings`."""
    return f"{build_line(folder, ('cork', 'mug'))} --config single_shot --light {light}"


def start(line):
    """A build in a separate process and process group."""
    return subprocess.Popen(
        [*COMMAND, *line.split()],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(reached, process, seconds=300):
    """Wait until ``reached()`` holds; False when the process ended before."""
    end = time.monotonic() + seconds
    while not reached():
        if process.poll() is not None:
            return False
        assert time.monotonic() < end, "the build never got that far"
        time.sleep(0.001)
    return True


def final_shards(folder):
    return sorted(folder.rglob("*.arrow"))


def group_members(group):
    """Living processes of a process group, by /proc."""
    members = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            members.append(int(stat.parent.name))
    return members


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A folder whose build was stopped in its second shard, and whose lock is free. Copy it before
    changing it."""
    folder, views = tmp_path_factory.mktemp("stopped") / "half", []
    photograph = Studio.photograph

    def stop_at_eight(self, mesh, view):
        views.append(view)
        if len(views) == 8:
            raise KeyboardInterrupt
        return photograph(self, mesh, view)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Studio, "photograph", stop_at_eight)
        with pytest.raises(KeyboardInterrupt):
            build(folder, half_settings(), workers=1)
    assert len(final_shards(folder)) == 1 and not (folder / "manifest.json").exists()
    return folder


@pytest.fixture
def direct_light(tmp_path):
    """`DIRECT` as a file for the command."""
    file = tmp_path / "direct.yaml"
    file.write_text(yaml.safe_dump(DIRECT.model_dump(mode="json")))
    return file


@pytest.fixture
def half_built(stopped, tmp_path):
    """A copy of `stopped`."""
    return Path(shutil.copytree(stopped, tmp_path / "half"))


def half_settings(**changes):
    """Of two objects and one frame, in `DIRECT` light."""
    return tiny_settings(
        **{"objects": ("cork", "mug"), "stored": "single_shot", "light": DIRECT, **changes}
    )


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Files of the dataset of `half_built`, built without interruption."""
    folder = tmp_path_factory.mktemp("uninterrupted") / "set"
    build(folder, half_settings(), workers=1)
    return file_bytes(folder)


@pytest.mark.processes
def test_killed_again_and_again_and_resumed_to_the_same_bytes(tiny, tmp_path):
    folder = tmp_path / "killed"
    work = folder / ".build"

    def largest(pattern):
        """Size of the largest unfinished file of that name."""
        sizes = [0]
        for path in folder.glob(pattern):
            with contextlib.suppress(FileNotFoundError):  # finished and renamed meanwhile
                sizes.append(path.stat().st_size)
        return max(sizes)

    moments = [
        (1, lambda: largest("train/.*.tmp") > 1_000_000),  # in the middle of a shard
        (1, lambda: (work / "train-00000-of-00001.json").exists()),  # straight after the first
        (2, lambda: largest("*/.*.tmp") > 100_000),  # with two worker processes
        (1, lambda: largest("test/.*.tmp") > 1_000_000),
    ]
    reached = 0
    for workers, moment in moments:
        process = start(build_line(folder, workers=workers))
        if wait_for(moment, process):
            reached += 1
            if reached == 1:
                # While it runs, a second build into the folder is refused.
                said = refusal(fpp_bench, build_line(folder))
                assert "another process is writing" in said
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stderr.close()
        # No worker outlives its parent and writes into an unlocked folder.
        end = time.monotonic() + 120
        while group_members(process.pid):
            assert time.monotonic() < end
            time.sleep(0.02)
        whole_shards = file_bytes(tiny)
        for shard in final_shards(folder):  # a file with its final name is complete
            assert shard.read_bytes() == whole_shards[str(shard.relative_to(folder))]
        if not (folder / "manifest.json").exists():
            with pytest.raises(DatasetError, match="not finished"):
                DatasetFolder(folder)
    assert reached >= 3
    build(folder, tiny_settings(), workers=1)
    assert file_bytes(folder) == file_bytes(tiny)
    assert not work.exists()


def test_resume_makes_only_what_is_missing(half_built, uninterrupted, monkeypatch):
    names, photograph = [], Studio.photograph

    def count(self, mesh, view):
        names.append(mesh.name)
        return photograph(self, mesh, view)

    monkeypatch.setattr(Studio, "photograph", count)
    reported = []
    build(half_built, half_settings(), workers=1, progress=reported.append)
    assert names == ["mug"] * 6
    assert reported == [6, *[1] * 6]
    assert file_bytes(half_built) == uninterrupted


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


RECEIPT = ".build/train-00000-of-00001.json"


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("train/*.arrow", flip),
        ("train/*.arrow", cut),
        ("train/*.arrow", Path.unlink),
        ("meshes/cork.ply", Path.unlink),
        (RECEIPT, cut),
        (RECEIPT, lambda path: path.write_text('{"files": [], "rows": []}')),
    ],
)
def test_resume_trusts_no_damaged_work(half_built, uninterrupted, name, damage):
    (path,) = half_built.glob(name)
    damage(path)
    build(half_built, half_settings(), workers=1)
    assert file_bytes(half_built) == uninterrupted


def test_leftovers_of_a_kill_and_files_of_others_do_not_become_part_of_the_dataset(
    half_built, uninterrupted
):
    for name in (
        ".README.md.123.tmp",
        "train/.state.json.9.tmp",
        "meshes/.mug.ply.tmp",
        ".build/test.1.data.tmp",
        ".build/.x.json.7.tmp",
    ):
        (half_built / name).write_text("half a file")
    (half_built / "notes.txt").write_text("mine")
    build(half_built, half_settings(), workers=1)
    files = file_bytes(half_built)
    assert files.pop("notes.txt") == b"mine"
    assert files == uninterrupted
    findings = verify(half_built)
    assert len(findings) == 1 and "notes.txt" in findings[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 43}, r"seed \(there 42, now 43\)"),
        ({"objects": ("cork", "bowl")}, r"objects \(there \[\"mug\", \"cork\"\], now"),
        ({"light": named_light("hard")}, "light"),
    ],
)
def test_other_settings_are_refused_by_name_before_and_after_the_end(half_built, change, message):
    for _ in range(2):
        before = file_bytes(half_built)
        with pytest.raises(BuildError, match=message):
            build(half_built, half_settings(**change), workers=1)
        assert file_bytes(half_built) == before
        build(half_built, half_settings(), workers=1)


def test_half_a_dataset_of_another_version_is_not_finished(half_built, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.loaders.render.builder.__version__", "0.0.9")
    with pytest.raises(BuildError, match="version"):
        build(half_built, half_settings(), workers=1)


def test_finished_folder_is_left_alone_unless_a_shard_is_gone(half_built, direct_light):
    build(half_built, half_settings(), workers=1)

    def stamps():
        return {path: path.stat().st_mtime_ns for path in half_built.rglob("*") if path.is_file()}

    before, line = stamps(), half_line(half_built, direct_light)
    assert "complete already" in printed(fpp_bench, line)
    assert stamps() == before
    final_shards(half_built)[0].unlink()
    assert "missing" in refusal(fpp_bench, line)


@pytest.mark.parametrize("name", ["", "thesis.tex", "manifest.json"])
def test_folders_with_other_content(tmp_path, name):
    """A file in the folder's place, files of others, a dataset of others."""
    folder = tmp_path / "out"
    if name:
        folder.mkdir()
    (folder / name).write_text("{}")
    with pytest.raises(DatasetError, match=str(folder)):
        build(folder, half_settings(), workers=1)
    assert (folder / name).read_text() == "{}"


def test_lock_is_free_after_an_error(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(Studio, "photograph", Mock(side_effect=BuildError("no")))
        with pytest.raises(BuildError, match="no"):
            build(tmp_path / "set", tiny_settings(**SMALL), workers=1)
            build(tmp_path / "set", tiny_settings(**SMALL), workers=1)
    assert not list((tmp_path / "set").rglob("*.tmp"))
    build(tmp_path / "set", tiny_settings(**SMALL), workers=1)
    assert verify(tmp_path / "set") == []


# ---- dying workers


def die(plan, folder):
    if plan.split == "validation":
        os._exit(9)  # as the system ends a process that took too much memory
    return assembly_of(half_settings()).rows(plan, folder)


@pytest.mark.processes
def test_death_of_a_worker_is_an_error_that_says_so_and_the_rest_is_kept(tmp_path, uninterrupted):
    folder = tmp_path / "set"
    assembly = assembly_of(half_settings())
    broken = Assembly(assembly.plans, die, assembly.manifest, assembly.mesh_folder)
    with pytest.raises(
        PoolError, match=r"worker process died .* run the same command again, it resumes"
    ):
        assemble(folder, broken, workers=2)
    assert not (folder / "manifest.json").exists()
    build(folder, half_settings(), workers=1)
    assert file_bytes(folder) == uninterrupted


@pytest.mark.processes
def test_sigterm_to_a_build_in_processes_makes_no_noise(tmp_path, uninterrupted, direct_light):
    folder = tmp_path / "set"
    process = start(f"{half_line(folder, direct_light)} --workers 2")
    assert wait_for(lambda: list(folder.glob("*/.*.tmp")), process)
    os.killpg(process.pid, signal.SIGTERM)
    errors = process.communicate(timeout=60)[1]
    assert process.returncode == 143
    assert errors.endswith("fpp-bench build: stopped; the same command continues\n")
    assert "Traceback" not in errors and "resource_tracker" not in errors
    deadline = time.monotonic() + 30  # its helper process may outlive it by a moment
    while group_members(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not group_members(process.pid)
    build(folder, half_settings(), workers=1)
    assert file_bytes(folder) == uninterrupted


# ---- full disks


def test_full_disk_is_refused_beforehand(tmp_path):
    with small_disk(tmp_path / "disk", "1500k") as full_disk:
        message = refusal(fpp_bench, build_line(full_disk / "set", ("cork",)))
        assert "GB free" in message and str(full_disk) in message
        assert not final_shards(full_disk)


@pytest.mark.processes
def test_files_that_can_not_grow(tmp_path, direct_light, uninterrupted):
    """No space in the middle of a shard, through a limit on file sizes (EFBIG), which needs no
    privileges."""
    folder = tmp_path / "set"
    arguments = [*COMMAND, *half_line(folder, direct_light).split()]
    limit = 1_000_000  # bytes; a shard has 1.7 million

    def no_large_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    # Machine code that `uninterrupted` left in the cache is not compiled and written again.
    done = subprocess.run(
        arguments, cwd=ROOT, capture_output=True, text=True, preexec_fn=no_large_files
    )
    assert done.returncode == 2
    assert os.strerror(errno.EFBIG) in done.stderr and "resumes" in done.stderr
    assert "Traceback" not in done.stderr
    assert not final_shards(folder) and not list(folder.rglob("*.tmp"))
    build(folder, half_settings(), workers=1)
    assert file_bytes(folder) == uninterrupted


@pytest.mark.long
@pytest.mark.parametrize("name", ["README.md", "manifest.json", "state.json"])
def test_disk_that_is_full_at_the_very_end(tmp_path, uninterrupted, monkeypatch, name):
    """No space for a small file: the card, the manifest, a state file."""
    folder = tmp_path / "set"
    replace = Path.replace

    def no_space(self, target):
        if name in target.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))
        return replace(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", no_space)
        with pytest.raises(BuildError, match="No space left on device"):
            build(folder, half_settings(), workers=1)
    assert not (folder / "manifest.json").exists()
    build(folder, half_settings(), workers=1)
    assert file_bytes(folder) == uninterrupted
