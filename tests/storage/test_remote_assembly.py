"""Datasets at a URL and by a cluster: the files of a local run, resumed shard by shard."""

from dataclasses import dataclass, replace

import pytest
from conftest import file_bytes
from synthetic import SyntheticRows, assembly

from fpp_ml_bench.errors import BuildError, PoolError
from fpp_ml_bench.loaders.storage.assembly import ShardWork, assemble
from fpp_ml_bench.remote import RemoteFolder

SHARDS = [12, 6, 6]
"""Rows of each shard of the noise."""


@dataclass(frozen=True)
class RowsAndMeshes(SyntheticRows):
    """Rows of noise, and a file for each object as the builder writes; ``stop`` is a split that is
    never reached."""

    stop: str | None = None

    def __call__(self, plan, folder):
        if plan.split == self.stop:
            raise KeyboardInterrupt
        for _, name, _ in plan.samples:
            (folder / "meshes").mkdir(exist_ok=True)
            (folder / "meshes" / f"{name}.ply").write_text(name)
        return super().__call__(plan, folder)


def noise(seed=42, **changes):
    made = assembly()
    manifest = replace(made.manifest, settings={"seed": seed})
    return replace(made, rows=RowsAndMeshes(**changes), manifest=manifest, mesh_folder="meshes")


@pytest.fixture
def local(tmp_path):
    assemble(tmp_path / "local", noise(), workers=1)
    return file_bytes(tmp_path / "local")


@pytest.fixture
def remote(tmp_path):
    return RemoteFolder((tmp_path / "remote").as_uri())


def test_a_url_gets_the_same_files(local, remote, tmp_path):
    advanced = []
    manifest = assemble(remote, noise(), progress=advanced.append)
    assert file_bytes(tmp_path / "remote") == local and advanced == [0, *SHARDS]
    (tmp_path / "remote/.build").mkdir()
    (tmp_path / "remote/.build/settings.json").write_text("{}")
    assert assemble(remote, noise()) == manifest  # finished
    assert file_bytes(tmp_path / "remote") == local
    with pytest.raises(BuildError, match=r"other settings: seed \(there 42, now 7\)"):
        assemble(remote, noise(7))
    (tmp_path / "remote/meshes/mug.ply").unlink()
    with pytest.raises(BuildError, match=r"meshes/mug\.ply is missing or cut off"):
        assemble(remote, noise())


def test_in_the_middle_only_what_is_missing_or_cut_off_is_written_again(local, remote, tmp_path):
    folder, advanced = tmp_path / "remote", []
    with pytest.raises(KeyboardInterrupt):
        assemble(remote, noise(stop="test"))
    with pytest.raises(BuildError, match="other settings"):
        assemble(remote, noise(7))
    assert not (folder / "manifest.json").exists() and len(list(folder.rglob("*.arrow"))) == 2
    (folder / "train/.data-00000-of-00001.arrow.123.tmp").write_bytes(b"of a killed task")
    shard = folder / "validation/data-00000-of-00001.arrow"
    shard.write_bytes(shard.read_bytes()[:-1])
    (folder / ".build/test-00000-of-00001.json").write_text("{")
    assemble(remote, noise(), progress=advanced.append)
    assert advanced == [SHARDS[0], *SHARDS[1:]] and file_bytes(folder) == local


def test_a_url_with_other_files_is_refused(remote, tmp_path):
    (tmp_path / "remote").mkdir()
    (tmp_path / "remote/letter.txt").write_text("mine")
    with pytest.raises(BuildError, match="holds other files and no dataset"):
        assemble(remote, noise())


@pytest.mark.parametrize("shared", [True, False])
def test_a_cluster_writes_the_same_files_and_goes_on_where_it_died(
    shared, local, remote, fake_ray, tmp_path
):
    advanced = []

    def run(progress=lambda rows: None):
        if shared:
            assemble(tmp_path / "remote", noise(), 1, progress, fake_ray.address)
        else:
            assemble(remote, noise(), 1, progress, fake_ray.address)

    fake_ray.dies = 2
    with pytest.raises(PoolError, match="the cluster failed"):
        run()
    run(advanced.append)
    assert advanced == [SHARDS[0], *SHARDS[1:]] and fake_ray.started == 4
    assert file_bytes(tmp_path / "remote") == local


def test_a_node_that_does_not_see_the_folder_or_url_says_so(remote, tmp_path):
    plan, made = noise().plans[0], noise()
    for place in (tmp_path, remote):
        with pytest.raises(
            BuildError,
            match="does not find the build there; give a folder that all nodes share, or a",
        ):
            ShardWork(made, place).write(plan)
