"""Publishing a dataset to a Hub on the loopback interface, through the real client; read back with
``load_dataset``."""

import json
import re
import socket
import subprocess
import sys
from io import BytesIO
from unittest.mock import Mock

import cv2
import mlcroissant
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from conftest import TINY_CONFIGS, flip, fpp_bench, printed, refusal
from datasets import Array2D, Features, Image
from hub_server import Repo
from huggingface_hub import constants
from publishing import DATA, ODD_OBJECT, ROOT, SIZE, listed, make_all_frames, running_hub
from scored_dataset import make_dataset

from fpp_ml_bench.loaders.sample import config_columns

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running_hub(tmp_path_factory.mktemp("hub") / "home") as client:
        yield client


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_all_frames(tmp_path_factory.mktemp("all") / "dataset", odd=True)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Frame 0 alone."""
    return make_dataset(tmp_path_factory.mktemp("small") / "dataset", size=SIZE)


@pytest.fixture(scope="module")
def published(client, dataset):
    """What the runs said that published the dataset as ``alice/fpp``: dry, real, again."""
    call = f"dataset {dataset.path} --repo alice/fpp"
    client.server.writes()
    dry = client.good(f"{call} --dry-run")
    dry_writes, dry_repos = client.server.writes(), dict(client.server.repos)
    real = client.good(call)
    real_writes = client.server.writes()
    again = client.good(call)
    return {
        "dry": (dry, dry_writes, dry_repos),
        "real": (real, real_writes),
        "again": (again, client.server.writes()),
    }


def test_a_dry_run_says_everything_and_changes_nothing(published):
    output, writes, repos = published["dry"]
    assert listed(output) == dict.fromkeys(
        [
            *DATA,
            "README.md",
            "croissant.json",
            "eval.yaml",
            "fpp-bench.json",
            "meshes/bowl.ply",
            "overview.png",
            "rig.yaml",
        ],
        "new",
    )
    assert "(new, public)" in output
    assert "Dry run: nothing was sent." in output
    assert (writes, repos) == ([], {})


def test_the_real_run_does_what_the_dry_run_said(published, client):
    output, writes = published["real"]
    assert listed(output) == listed(published["dry"][0])
    repo = client.server.repos["datasets", "alice/fpp"]
    assert set(repo.files) == {*listed(output), ".gitattributes"}
    assert len(repo.commits) == 2  # the Hub's own, and one that makes everything visible at once
    assert not repo.private
    assert (
        sum(method == "PUT" for method, _ in writes) == 5
    )  # three Parquet files, a mesh and the picture


def test_a_second_run_sends_nothing(published):
    output, writes = published["again"]
    assert set(listed(output).values()) == {"unchanged"}
    assert "Nothing to send" in output
    assert writes == []


READ_BACK = """
import json, sys, datasets, numpy as np
out = sys.argv[1]
for config in datasets.get_dataset_config_names("alice/fpp"):
    for split, rows in datasets.load_dataset("alice/fpp", config).items():
        features = {name: type(feature).__name__ for name, feature in rows.features.items()}
        rows = list(rows.with_format("numpy"))
        columns = {name: np.stack([row[name] for row in rows]) for name in features}
        np.savez(f"{out}/{config}-{split}.npz", **columns, features=json.dumps(features))
# To the end: Arrow's threads abort the process where a stream is dropped half read (datasets issues 7467 and 7566).
first, *_ = datasets.load_dataset("alice/fpp", split="test", streaming=True)
assert first["frame_00"].mode == "L", first["frame_00"].mode
np.save(f"{out}/streamed.npy", np.asarray(first["frame_00"]))
"""


@pytest.mark.processes
def test_load_dataset_reads_the_same_rows_of_every_configuration(
    published, client, dataset, tmp_path
):
    done = subprocess.run(
        [sys.executable, "-c", READ_BACK, str(tmp_path)],
        env=client.environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    same_bits(np.load(tmp_path / "streamed.npy"), dataset.frame(dataset.splits["test"][0], 0))
    assert dataset.configs == TINY_CONFIGS
    for config in dataset.configs:
        for split, samples in dataset.splits.items():
            names = config_columns(dataset.sequence, config, exact=True)
            with np.load(tmp_path / f"{config}-{split}.npz") as columns:
                features = json.loads(str(columns["features"]))
                images = {"depth_preview", *(name for name in names if name.startswith("frame_"))}
                assert set(features) == {*names, "depth_preview"}
                assert {name for name, kind in features.items() if kind == "Image"} == images
                assert list(columns["sample"]) == samples
                assert list(columns["object"]) == [
                    dataset.measured(sample)["object"] for sample in samples
                ]
                for row, sample in enumerate(samples):
                    for index in dataset.sequence.config(config):
                        same_bits(columns[f"frame_{index:02d}"][row], dataset.frame(sample, index))
                    for name in ("depth", "depth_exact"):
                        same_bits(columns[name][row], dataset.depth_mm(sample, name))
                    assert columns["depth_max"][row] == dataset.depth_mm(sample).max()


def same_bits(loaded: np.ndarray, expected: np.ndarray) -> None:
    assert loaded.shape == expected.shape and loaded.dtype == expected.dtype
    assert loaded.tobytes() == expected.tobytes()


def test_a_name_with_markup_is_shown_as_it_is(published, client):
    card = client.server.repos["datasets", "alice/fpp"].files["README.md"].decode()
    body = card.split("---\n", 2)[2]
    assert ODD_OBJECT not in body
    assert "&#95;&#95;odd&#95;&#95;-name&#95;" in body


def test_the_published_croissant_is_valid(published, client, dataset):
    content = json.loads(client.server.repos["datasets", "alice/fpp"].files["croissant.json"])
    read = mlcroissant.Dataset(content)
    assert not read.metadata.ctx.issues.report()
    assert [one.name for one in read.metadata.record_sets] == list(dataset.splits)
    assert content["url"].endswith("datasets/alice/fpp") and content["rai:hasSyntheticData"]
    first = {field["name"]: field for field in content["recordSet"][0]["field"]}
    assert first["frame_00"]["dataType"] == "sc:ImageObject"
    assert first["depth"]["arrayShape"] == ",".join(map(str, SIZE))


def test_the_card_names_columns_and_files_of_each_configuration(published, client, dataset):
    files = client.server.repos["datasets", "alice/fpp"].files
    head, body = files["README.md"].decode().split("---\n", 2)[1:]
    height, width = SIZE
    for config in yaml.safe_load(head)["configs"]:
        names = config_columns(dataset.sequence, config["config_name"], exact=True)
        assert set(config["columns"]) == {*names, "depth_preview"}
        for split in config["data_files"]:
            tables = [pq.ParquetFile(BytesIO(files[path])) for path in split["path"]]
            assert sum(table.metadata.num_rows for table in tables) == len(
                dataset.splits[split["split"]]
            )
            features = Features.from_arrow_schema(tables[0].schema_arrow)
            assert features["depth"] == Array2D(SIZE, "float32")
            assert isinstance(features[names[4]], Image)
    for name in ("sample", "depth", "depth_exact", "flags", "cover", "depth_min", "depth_preview"):
        assert f"| `{name}` |" in body
    assert "| `frame_00` ... `frame_51` | image, 8-bit grey | grey level |" in body
    assert "## Limitations" in body and "10.1117/12.3082257" in body
    picture = cv2.imdecode(np.frombuffer(files["overview.png"], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (2 * height, 4 * width, 3) and "](overview.png)" in body
    assert len(np.unique(picture[height:].reshape(-1, 3), axis=0)) > 2  # the depths


@pytest.mark.parametrize(
    ("what", "offline"), [("dataset", True), ("dataset", False), ("leaderboard", False)]
)
def test_a_dry_run_works_without_a_network(small, monkeypatch, what, offline):
    refuse = Mock(side_effect=OSError("no network in this test"))
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", offline)
    call = f"publish {what} {small.path if what == 'dataset' else ''} --repo alice/never"
    output = printed(fpp_bench, call, "--dry-run")
    expected = (
        {*DATA, "README.md", "overview.png"} if what == "dataset" else {"README.md", "index.html"}
    )
    assert expected <= listed(output).keys() and set(listed(output).values()) == {"new"}
    reason = "HF_HUB_OFFLINE is set" if offline else "can't be reached"
    assert re.search(rf"Nothing was asked of the Hub: .*{reason}", output)
    assert "Dry run: nothing was sent." in output
    monkeypatch.setenv("HF_TOKEN", "hf_good")
    assert reason in refusal(fpp_bench, call)


def test_the_benchmark_is_registered(published, client):
    evaluation = yaml.safe_load(client.server.repos["datasets", "alice/fpp"].files["eval.yaml"])
    assert evaluation["evaluation_framework"] == "fpp-ml-bench"
    for name, config in (("single_shot_depth", "single_shot"), ("multi_frame_depth", "all")):
        assert {"id": name, "config": config, "split": "test"} in evaluation["tasks"]


def test_other_data_replaces_what_changed_and_leaves_what_others_added(client, tmp_path):
    first = make_dataset(tmp_path / "first", size=SIZE)
    second = make_all_frames(tmp_path / "second", seed=1)
    client.good(f"dataset {first.path} --repo alice/replaced")
    repo = client.server.repos["datasets", "alice/replaced"]
    repo.files |= {"NOTES.txt": b"by hand", "data/stray.parquet": b"old"}
    staged = tmp_path / "staged"
    call = f"dataset {second.path} --repo alice/replaced --staging {staged}"
    output = client.good(call)
    assert listed(output)["data/stray.parquet"] == "deleted"
    assert "NOTES.txt" not in listed(output)
    assert listed(output)[DATA[2]] == "changed"
    assert "data/stray.parquet" not in repo.files and repo.files["NOTES.txt"] == b"by hand"
    # A kept staging folder is continued, not written again; and it changes nothing on the Hub.
    modified = {path: path.stat().st_mtime_ns for path in staged.rglob("*.parquet")}
    assert len(modified) == 3
    (staged / "files" / "data" / ".test.parquet.1.tmp").write_bytes(b"of a run that was killed")
    client.server.writes()
    assert "Nothing to send" in client.good(call)
    assert {path: path.stat().st_mtime_ns for path in staged.rglob("*.parquet")} == modified
    assert client.server.writes() == []


def test_a_run_that_was_cut_off_sends_only_what_is_missing(client, small):
    call = f"dataset {small.path} --repo cut/fpp"
    client.server.large.clear()
    client.server.writes()
    (first, second) = client.run(call, call)
    assert first[0] == 2 and "the Hub has a fault (500)" in first[2]
    assert second[0] == 0, second[2]
    writes = client.server.writes()
    assert sum(method == "PUT" for method, _ in writes) == 4  # each large file once, over both runs
    assert sum("/commit/" in path for _, path in writes) == 2
    assert len(client.server.repos["datasets", "cut/fpp"].commits) == 2


def test_refusals(client, small, tmp_path):
    """Everything that can go wrong before or on the way says what and what to do, with status 2 and
    no traceback."""
    good = f"dataset {small.path} --repo"
    client.good(f"{good} alice/public")
    client.server.repos["datasets", "alice/other"] = Repo(files={"train.csv": b"a,b\n"})
    client.server.repos["datasets", "raced/fpp"] = Repo()
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "thesis.tex").write_text("mine")
    cases = [
        (f"{good} nobody", "OWNER/NAME"),
        (f"{good} alice/\x1b[31mred", r"\\x1b"),
        (f"{good} bob/fpp", "make repositories of alice"),
        (
            f"{good} forbidden/fpp",
            r"403\); it needs write access.*The Hub says: You don't have the rights",
        ),
        (f"{good} broken/fpp", r"fault \(500\)"),
        (f"{good} alice/other", r"did not publish \(train.csv.*--adopt"),
        (f"{good} raced/fpp", r"committed meanwhile \(412\)"),
        (f"{good} alice/public --private", "exists and is public"),
        (f"{good} alice/new --staging {tmp_path}/occupied", "holds files"),
        ([*good.split(), "alice/new", "--license", "all rights: reserved"], "--license"),
        (f"dataset {tmp_path} --repo alice/new", "no dataset"),
        ("results r.json --repo alice/none --dataset-repo alice/public", "no such model"),
    ]
    client.server.writes()
    answers = client.run(*(call for call, _ in cases))
    for (call, message), (status, _, error) in zip(cases, answers, strict=True):
        assert status == 2, call
        assert re.search(message, error, re.DOTALL), (call, error)
        assert "Traceback" not in error and "\x1b" not in error
    assert set(client.server.repos["datasets", "raced/fpp"].files) == {".gitattributes"}
    assert ("datasets", "alice/new") not in client.server.repos
    assert (tmp_path / "occupied" / "thesis.tex").read_text() == "mine"


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"HF_TOKEN": None}, "no token for the Hub: run 'hf auth login'"),
        ({"HF_TOKEN": "hf_bad"}, r"does not accept the token \(401\)"),
        ({"HF_ENDPOINT": "http://127.0.0.1:9"}, "can't be reached.*check the network"),
        ({"HF_ENDPOINT": "127.0.0.1"}, "HF_ENDPOINT"),
        ({"HF_HUB_OFFLINE": "1"}, "HF_HUB_OFFLINE is set"),
    ],
    ids=("no token", "bad token", "connection refused", "bad endpoint", "offline"),
)
def test_no_way_to_the_hub(client, small, environment, message):
    client.server.writes()
    call = f"dataset {small.path} --repo alice/never"
    ((status, _, error),) = client.run(call, **environment)
    assert status == 2
    assert re.search(message, error, re.DOTALL), error
    assert "Traceback" not in error
    assert client.server.writes() == []


def test_adopting_and_private(client, small):
    repo = client.server.repos["datasets", "alice/adopted"] = Repo()
    repo.files["train.csv"] = b"a,b\n"
    call = f"dataset {small.path} --repo"
    (adopted, private, unseen) = client.run(
        f"{call} alice/adopted --adopt",
        f"{call} alice/secret --private",
        f"{call} alice/secret --dry-run",
    )
    assert adopted[0] == private[0] == unseen[0] == 0
    assert repo.files["train.csv"] == b"a,b\n" and DATA[0] in repo.files
    assert client.server.repos["datasets", "alice/secret"].private
    assert "(private)" in unseen[1]


def test_a_damaged_dataset_is_not_published(client, tmp_path):
    dataset = make_dataset(tmp_path / "d", size=SIZE)
    path = dataset.path / dataset.manifest.shards[0].path
    flip(path)
    ((status, _, error),) = client.run(f"dataset {dataset.path} --repo alice/damaged")
    assert status == 2 and path.name in error and "checksum" in error
    assert ("datasets", "alice/damaged") not in client.server.repos


@pytest.mark.processes
def test_help_does_not_wait_for_datasets_or_torch():
    code = (
        "import sys\nfrom fpp_ml_bench.cli import main\n"
        "assert main(['publish', 'dataset', '--help']) == 0\n"
        "print({'datasets', 'torch', 'pandas'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"
