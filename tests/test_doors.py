"""Every place that opens a file of a stranger, writes one, draws or prints by a library, is listed
here: a new one goes through the doors of `docs/architecture.md` ("Files from outside"), or is added
with its reason."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = "fpp_ml_bench", "loaders", "evaluation", "baselines", "leaderboard"

DOORS = {
    # What parses a foreign form; containers.py and mesh_files.py do it in the guarded process.
    r"(scipy\.io\.)?(loadmat|whosmat)|h5py\.File|Image\.open|cv2\.im(read|decode)|pq\.ParquetFile": {
        "fpp_ml_bench/containers.py",
        "loaders/render/mesh_files.py",  # in the guarded process
        "fpp_ml_bench/style.py",  # a picture that it drew itself
    },
    r"trimesh\.load\w*": {"loaders/render/mesh_files.py"},
    r"(pa\.)?ipc\.open_\w+|MemoryMappedTable\.from_file|pa\.(memory_map|OSFile)": {
        "fpp_ml_bench/containers.py",
        "loaders/storage/store.py",  # without the bodies; `datasets` maps what was checked
    },
    r"np\.(load|fromfile|memmap|loadtxt|genfromtxt)|pickle\.loads?|torch\.load|safe_open": {
        "baselines/learned/images.py",  # images that it made itself
        "baselines/robustness/axes.py",  # renderings that it made itself
        "baselines/registry.py",  # of the parent process
        "baselines/run.py",  # the shape of a prediction that it made itself
        "fpp_ml_bench/pool.py",  # between the nodes of one cluster
        "loaders/render/meshes.py",  # the objects, which come with the package
        "loaders/captures/decoding.py",  # bytes of bounded size
    },
    r"mmap\.mmap": {"loaders/storage/store.py"},  # of memory, of no file
    r"yaml\.(safe_)?load": {"fpp_ml_bench/files.py"},
    # What writes a file: all others by files.write_atomically, write_files, whole_file or
    # whole_folder.
    r"np\.save\w*\((?!content|buffer).*": set(),
    r".*\.write_(bytes|text)|shutil\.copy\w*": {
        "baselines/timing.py",  # a switch of the kernel
        "fpp_ml_bench/cli/options.py",  # text of the help
        "leaderboard/publish.py",  # a temporary folder
        "loaders/hub.py",  # a locked folder of its own
        "loaders/published/exporting.py",  # in a whole_folder
        "loaders/render/boards/captures.py",  # a folder that gets its name when it is complete
    },
    r"(.*\.)?open\(.*'[wxa]b?\+?'.*": {
        "baselines/run.py",  # the journal of a locked folder
        "evaluation/submission/description.py",  # a new file: "x"
        "fpp_ml_bench/cli/__init__.py",  # /dev/null
        "fpp_ml_bench/files.py",
    },
    # What prints or draws: a name is no markup, and a user's settings change nothing.
    r"(bar\.)?TextColumn|.*\.get_default_columns|Text\.from_markup": {"fpp_ml_bench/tables.py"},
    r"(rich\.)?Console": {"baselines/training/engine.py", "fpp_ml_bench/cli/console.py"},
    r"(matplotlib\.)?rc_context|plt\..*": {"fpp_ml_bench/style.py"},
    r"Figure\(figsize.*": {"baselines/tradeoff/report.py", "fpp_ml_bench/style.py"},
    r"filelock\.\w+|tempfile\.mktemp": {"fpp_ml_bench/files.py"},
}


def calls():
    """File and text of every call in the package: its function, and with its arguments."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    yield (
                        path.relative_to(ROOT).as_posix(),
                        ast.unparse(node.func),
                        ast.unparse(node),
                    )


@pytest.fixture(scope="module")
def called():
    return list(calls())


@pytest.mark.long
@pytest.mark.parametrize("door", DOORS)
def test_nobody_goes_around_a_door(door, called):
    form, whole = re.compile(door, re.DOTALL), r"\(" in door
    users = {file for file, function, call in called if form.fullmatch(call if whole else function)}
    assert users == DOORS[door]
