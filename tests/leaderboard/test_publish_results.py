"""The leaderboard's page as a static Space, results in a model's repository, and what decides which
file is sent."""

import json

import numpy as np
import pytest
import yaml
from board_rows import write_result_file
from conftest import fpp_bench
from hub_server import Repo
from huggingface_hub import parse_eval_result_entries
from publishing import SIZE, listed, running_hub
from scored_dataset import make_dataset

from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.leaderboard.publish import hub_score
from fpp_ml_bench.loaders.hub import Publication, Remote, changes, check_repo_name
from fpp_ml_bench.loaders.storage.parquet import preview

pytestmark = pytest.mark.long

HOSTILE = "</script>: [*x]({y}) | `z` - !!python/object:os.system"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running_hub(tmp_path_factory.mktemp("hub") / "home") as client:
        yield client


@pytest.fixture(scope="module")
def scored(client, tmp_path_factory):
    """Published dataset ``alice/scored``, and result files by name."""
    folder = tmp_path_factory.mktemp("scored")
    dataset = make_dataset(folder / "dataset", size=SIZE)
    small = make_dataset(folder / "other", size=(28, 28))
    client.good(["dataset", str(dataset.path), "--repo", "alice/scored"])
    results = {}
    for name, data, offset_mm, about in (
        ("good", dataset, 10.0, {"name": HOSTILE, "seconds_source": "self-reported"}),
        ("better", dataset, 1.0, {}),
        ("many", dataset, 10.0, {"frames_used": [*range(18)], "uses_ground_truth_range": True}),
        ("other", small, 10.0, {}),
        ("train", dataset, 10.0, {"split": "train"}),
        ("exact", dataset, 10.0, {"target": "depth_exact"}),
    ):
        results[name] = write_result_file(folder / f"{name}.json", data, offset_mm, **about)
    return results


def entry(client, repo: str, task: str):
    """The one entry of a task's file, as the client reads it."""
    content = client.server.repos["models", repo].files[f".eval_results/{task}--alice--scored.yaml"]
    (parsed,) = parse_eval_result_entries(yaml.safe_load(content))
    return parsed


def test_results_parse_back(client, scored):
    client.server.repos["models", "alice/unet"] = Repo(
        files={"README.md": b"card", ".eval_results/hle.yaml": b"[]"}
    )
    call = ["results", str(scored["good"]), str(scored["many"]), "--repo", "alice/unet"]
    call += ["--dataset-repo", "alice/scored"]
    client.server.writes()
    dry = client.good([*call, "--dry-run", "--source-url", "https://example.org/page"])
    assert client.server.writes() == []
    output = client.good([*call, "--source-url", "https://example.org/page"])
    assert (
        listed(output)
        == listed(dry)
        == {
            ".eval_results/multi_frame_depth_oracle_range--alice--scored.yaml": "new",
            ".eval_results/single_shot_depth--alice--scored.yaml": "new",
        }
    )
    ((status, alone, error),) = client.run([*call, "--dry-run"], HF_HUB_OFFLINE="1")
    assert status == 0 and listed(alone) == listed(dry), error
    assert (
        "HF_HUB_OFFLINE is set" in alone
        and "not compared with the content of alice/scored" in alone
    )
    repo = client.server.repos["models", "alice/unet"]
    assert repo.files["README.md"] == b"card" and repo.files[".eval_results/hle.yaml"] == b"[]"
    single = entry(client, "alice/unet", "single_shot_depth")
    result = json.loads(scored["good"].read_text())
    assert result["metrics"]["object_mae_mm"] == pytest.approx(10.0, rel=1e-6)
    assert single.value == pytest.approx(50.0, abs=1e-4)  # 100 / (1 + 10 mm / 10 mm)
    assert (single.dataset_id, single.task_id) == ("alice/scored", "single_shot_depth")
    assert single.dataset_revision == client.server.repos["datasets", "alice/scored"].commits[-1]
    assert single.date == result["created"][:10]
    assert (single.source_url, single.source_name) == (
        "https://example.org/page",
        "FPP-ML-Bench leaderboard",
    )
    assert "Object MAE 10.000 mm" in single.notes and "higher is better" in single.notes
    assert "metric track, 1 frame" in single.notes and "self-reported" in single.notes
    assert HOSTILE not in single.notes and "script" not in single.notes
    assert (
        "oracle range track, 18 frames"
        in entry(client, "alice/unet", "multi_frame_depth_oracle_range").notes
    )


def test_a_second_run_sends_nothing_and_a_better_result_replaces(client, scored):
    client.server.repos["models", "alice/mlp"] = Repo()
    call = ["--repo", "alice/mlp", "--dataset-repo", "alice/scored"]
    first, second, better = client.run(
        *(["results", str(scored[name]), *call] for name in ("good", "good", "better"))
    )
    assert first[0] == second[0] == better[0] == 0
    assert "Nothing to send" in second[1]
    assert list(listed(better[1]).values()) == ["changed"]
    assert entry(client, "alice/mlp", "single_shot_depth").value == pytest.approx(
        100 / 1.1, abs=1e-4
    )
    assert len(client.server.repos["models", "alice/mlp"].commits) == 3


def test_results_that_belong_to_no_task_are_refused(client, scored, tmp_path):
    client.server.repos["models", "alice/refused"] = Repo()
    client.server.repos["datasets", "alice/unmarked"] = Repo()
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    call = ["results", "--repo", "alice/refused", "--dataset-repo", "alice/scored"]
    cases = [
        ([*call, str(scored["other"])], "other data"),
        ([*call, str(scored["train"])], "this result on train against depth"),
        ([*call, str(scored["exact"])], "against depth_exact"),
        ([*call, str(scored["good"]), str(scored["better"])], "both results of single_shot_depth"),
        ([*call, str(broken)], "no valid JSON"),
        ([*call, str(scored["good"]), "--source-url", "javascript:alert(1)"], "https address"),
        ([*call[:-1], "alice/unmarked", str(scored["good"])], "not published by fpp-bench"),
        ([*call[:-1], "alice/nowhere", str(scored["good"])], "no such dataset"),
    ]
    client.server.writes()
    for (arguments, message), (status, _, error) in zip(
        cases, client.run(*(case for case, _ in cases)), strict=True
    ):
        assert status == 2 and message in error and "Traceback" not in error, (arguments, error)
    assert client.server.writes() == []


def test_the_page_becomes_a_static_space(client, scored, tmp_path):
    results = str(scored["good"]), str(scored["many"])
    assert fpp_bench("leaderboard", *results, "--page", tmp_path / "page") == 0
    call = ["leaderboard", "--repo", "alice/board", "--dataset-repo", "alice/scored"]
    client.server.writes()
    dry = client.good([*call, *results, "--dry-run"])
    assert ("spaces", "alice/board") not in client.server.repos and client.server.writes() == []
    first, second, third = client.run([*call, *results], [*call, *results], [*call, results[0]])
    assert first[0] == second[0] == third[0] == 0
    assert listed(dry) == listed(first[1])
    assert "Nothing to send" in second[1]
    deleted = {name for name, status in listed(third[1]).items() if status == "deleted"}
    pages = {f"submissions/{path.name}" for path in (tmp_path / "page" / "submissions").iterdir()}
    assert len(pages) == 2 and len(deleted) == 1 and deleted < pages
    space = client.server.repos["spaces", "alice/board"]
    assert space.sdk == "static" and len(space.commits) == 3
    head = yaml.safe_load(space.files["README.md"].decode().split("---\n")[1])
    assert (head["sdk"], head["app_file"], head["datasets"]) == (
        "static",
        "index.html",
        ["alice/scored"],
    )
    assert len(head["short_description"]) <= 60  # the Hub refuses more
    files = {".gitattributes", "README.md", "fpp-bench.json", "index.html", "data.json", "data.csv"}
    assert set(space.files) == {*files, *pages} - deleted
    (left,) = pages - deleted
    assert space.files[left] == (tmp_path / "page" / left).read_bytes()
    # Without results, the page is that of the shipped rows.
    assert listed(client.good(call))[left] == "deleted"


def test_the_score_stays_between_0_and_100():
    assert (hub_score(0.0), hub_score(10.0), hub_score(1e30)) == (100.0, 50.0, 0.0)


def test_repository_names():
    for name in ("A-1/b.c_d", "alice/" + "n" * 96):
        assert check_repo_name(name) == name
    for odd in ("a", "a/b/c", "/b", "a/b c", "a/..", "a/b--c", "a/b.git", "a/-b", "a/b\n", "ä/b"):
        with pytest.raises(PublishError, match="OWNER/NAME"):
            check_repo_name(odd)


def test_a_symbolic_link_is_not_published(tmp_path):
    (tmp_path / "link").symlink_to("/etc/passwd")
    with pytest.raises(PublishError, match="symbolic link"):
        changes(Publication("dataset", "a/b", tmp_path, "m"), Remote("c" * 40, files={}))


def test_preview_is_white_where_near():
    depth = np.zeros((500, 300), dtype=np.float32)
    depth[100:400, 50:250] = np.linspace(1800, 1900, 300, dtype=np.float32)[:, None]
    small = preview(depth)
    assert small.shape == (167, 100) and small.dtype == np.uint8
    assert (
        (small[depth[::3, ::3] == 0] == 0).all()
        and small.max() > 250
        and small[small > 0].min() >= 64
    )
    column = small[:, 50][small[:, 50] > 0].astype(int)
    assert (np.diff(column) <= 0).all()
    assert not preview(np.zeros((4, 4), dtype=np.float32)).any()
