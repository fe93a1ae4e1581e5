"""Maps: in this process and on a cluster, whose place a stand-in takes; the errors of each."""

import socket
import subprocess
import sys

import pytest
from conftest import fpp_bench, refusal

from fpp_ml_bench import pool
from fpp_ml_bench.errors import MeshError, PoolError
from fpp_ml_bench.pool import mapping

UNPACKED = []


class Work:
    def __setstate__(self, state):
        UNPACKED.append(state)

    def __getstate__(self):
        return {"half": 0.5}


def half_of(work, first, second):
    if second < 0:
        raise MeshError("does not fit")
    return (first + second) / 2


def test_a_cluster_gives_what_this_process_gives_and_takes_the_work_once(fake_ray):
    tasks = [3, 1, 2], [5, 1, 0]
    with mapping(Work()) as mapped:
        here = list(mapped(half_of, *tasks))
    UNPACKED.clear()
    with mapping(Work(), cluster=fake_ray.address) as mapped:
        assert list(mapped(half_of, *tasks)) == here == [4, 1, 1]
    assert fake_ray.addresses == [fake_ray.address] and not fake_ray.open
    assert UNPACKED == [{"half": 0.5}]


def test_an_error_of_a_task_is_raised_as_it_is(fake_ray):
    with (
        pytest.raises(MeshError, match="does not fit"),
        mapping(Work(), cluster=fake_ray.address) as mapped,
    ):
        list(mapped(half_of, [1, 1], [1, -1]))
    assert not fake_ray.open


_WAITING = """
import os, time
from fpp_ml_bench.pool import mapping

def sleep(work, number):
    os.write(1, b"%d\\n" % os.getpid())  # a line at once: both workers write to one pipe
    time.sleep(120)

if __name__ == "__main__":
    with mapping(None, 2) as mapped:
        list(mapped(sleep, range(2)))
"""


@pytest.mark.processes
@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal")
def test_no_worker_outlives_its_parent(tmp_path):
    (tmp_path / "waiting.py").write_text(_WAITING)
    parent = subprocess.Popen(
        [sys.executable, "waiting.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    for _ in range(2):
        assert int(parent.stdout.readline()) != parent.pid  # both are at work
    parent.kill()
    assert (
        parent.communicate(timeout=30)[0] == ""
    )  # returns when the last worker has closed its end


def test_a_task_that_dies_on_every_node_is_an_error_that_says_so(fake_ray):
    fake_ray.dies, finished = 2, []
    message = r"the cluster failed \(The worker died unexpectedly\); run the same command again"
    with (
        pytest.raises(PoolError, match=message),
        mapping(Work(), cluster=fake_ray.address) as mapped,
    ):
        finished += mapped(half_of, [1, 1, 1], [1, 2, 3])
    assert not fake_ray.open


def test_a_node_with_another_numpy_is_refused():
    sent = {**pool._versions(), "numpy": "1.0"}
    with pytest.raises(
        PoolError,
        match=r"has numpy \S+ and not 1\.0: results may differ; install the same versions",
    ):
        pool._run_task("run", sent, b"", half_of, 1, 2)


@pytest.mark.parametrize(
    "address", ["", "head", "ray://head", "http://head:80", "ray://:1", "ray://head:99999"]
)
def test_what_is_no_address_is_said(fake_ray, address):
    with (
        pytest.raises(PoolError, match=r"expected ray://HOST:PORT"),
        mapping(Work(), cluster=address),
    ):
        pass


def test_an_address_where_nobody_answers(fake_ray, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    line = f"build --out {tmp_path}/set --objects cork --size 176 --cluster"
    said = refusal(fpp_bench, line, f"127.0.0.1:{port}")
    assert f"nobody answers at 127.0.0.1:{port} (Connection refused)" in said
    assert fake_ray.addresses == []
    assert "give one of them" in refusal(fpp_bench, line, "x --workers 2")
