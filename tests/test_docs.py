"""Docs name only files and modules that are there."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import click
import pytest
from conftest import tiny_settings

from fpp_ml_bench.baselines.registry import GROUP
from fpp_ml_bench.cli import BENCH, COMMANDS, EVAL, Program
from fpp_ml_bench.cli.options import flags_of

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    {*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "evaluation/PROTOCOL.md"}
    - {ROOT / "CHANGELOG.md"}
)
of_each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
TO_BE_WRITTEN = {"leaderboard/rows/my-method.json", "leaderboard/rows/mine.json"}
OF_OTHER_PROGRAMS = {
    "--all-files",
    "--dist",
    "--cpu",
    "--index-url",
    "--num_machines",
    "--num_processes",
    "--shm-size",
}
"""Of pre-commit, pytest, pip, accelerate and Docker."""
TOP = "fpp_ml_bench|loaders|evaluation|baselines|leaderboard|tests|benchmarks|docs"


@of_each_page
def test_named_files_and_modules_are_there(page):
    text = page.read_text(encoding="utf-8")
    for name in set(re.findall(rf"(?<![\w/.-])((?:{TOP})/[\w/.-]*[\w/])", text)) - TO_BE_WRITTEN:
        assert (ROOT / name).exists(), name
    for link in set(re.findall(r"\]\(([^):# ]+)(?:#[^)]*| \"[^\"]*\")?\)", text)):
        assert (page.parent / link).exists(), link
    for name in set(re.findall(r"fpp_ml_bench(?:\.\w+)+", text)) - {GROUP}:
        parts = name.split(".")
        for count in range(len(parts), 0, -1):
            try:
                found = import_module(".".join(parts[:count]))
            except ModuleNotFoundError:
                continue
            for part in parts[count:]:
                found = getattr(found, part)
            break


FENCED = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", flags=re.DOTALL | re.MULTILINE)
ENDS_A_COMMAND = {"|", "||", "&&", ";", ">", ">>", "<"}


def _command_and_words(words):
    """The command that a command line runs, or the program where it names none, and the words that
    it parses."""
    program, *rest = words
    command = {"fpp-bench": BENCH, "fpp-eval": EVAL}[program]
    while isinstance(command, Program):
        name = rest[0] if rest and rest[0] in command.commands else command.default
        if not name:
            break
        rest = rest[1:] if rest and rest[0] == name else rest
        command = command.command(name)
    return command, rest


def _options(command):
    """Flags of a command, or of all commands of a program."""
    if isinstance(command, Program):
        return set().union(*(_options(command.command(name)) for name in command.commands))
    return set(flags_of(_context(command, [])))


def _context(command, words):
    """The context of a command that parses the words, or of its help where they lack an
    argument."""
    try:
        return command.make_context("x", [*words])
    except click.MissingParameter as error:
        return error.ctx


def _commands(text):
    """The command lines of this package in fenced blocks, as words."""
    for _, block in FENCED.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            if begin := re.search(r"(?<![\w./-])fpp-(?:bench|eval) ", line):
                words = shlex.split(line[begin.start() :], comments=True)
                end = next(
                    (
                        n
                        for n, word in enumerate(words)
                        if word in ENDS_A_COMMAND or word[:2] == "2>"
                    ),
                    None,
                )
                yield words[:end]


@of_each_page
def test_the_commands_of_a_page_are_accepted_by_their_parsers(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from fpp_ml_bench import Method\nclass Mine(Method):\n    name = 'mine'\n"
    )
    for words in _commands(page.read_text(encoding="utf-8")):
        command, rest = _command_and_words(words)
        try:
            command.make_context("x", rest)
        except click.exceptions.Exit:  # of --help
            pass
        except (click.UsageError, AttributeError) as error:
            pytest.fail(f"{page.name}: {' '.join(words)}: {error}")


def test_commands_are_found_in_the_pages():
    """The test above sees the commands, and would see a wrong one."""
    readme, commands = (
        list(_commands((ROOT / page).read_text())) for page in ("README.md", "docs/commands.md")
    )
    assert len(readme) >= 12 and ["fpp-eval", "init", "predictions"] in readme
    assert {words[1] for words in commands if words[0] == "fpp-bench"} == set(COMMANDS)
    ((wrong,),) = [
        list(_commands("```bash\nx && fpp-bench predict phase d --stripes both | cat # why\n```\n"))
    ]
    assert wrong == ["fpp-bench", "predict", "phase", "d", "--stripes", "both"]
    command, rest = _command_and_words(wrong)
    with pytest.raises(click.NoSuchOption):
        command.make_context("x", rest)


@of_each_page
def test_options_named_in_the_text_of_a_page_exist(page):
    """Options beside their command are options of this command; those alone are options of some
    command or script."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    for span in re.findall(r"`(fpp-(?:bench|eval) [^`]*)`", text):
        words = span.split()
        if words[0] == "fpp-eval" or words[1] in COMMANDS:
            known = _options(_command_and_words(words)[0])
            assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", span)) <= known, span
    known = _options(BENCH) | _options(EVAL)
    scripts = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "benchmarks").glob("*.py")
    )
    known |= set(re.findall(r"--[a-z][\w-]*", scripts)) | OF_OTHER_PROGRAMS
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text)) <= known


@pytest.mark.long
def test_python_of_the_pages_runs(tiny, tmp_path, monkeypatch):
    """Block by block, with small datasets in the place of the named ones. README's:
    tests/cli/test_front_door.py."""
    from fpp_ml_bench.loaders.render.builder import build
    from fpp_ml_bench.optics.named_rigs import paper_rig

    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    Path("data/mini").symlink_to(tiny)
    build(
        Path("data/small"), tiny_settings(rig=paper_rig(224), objects=("power_drill",)), workers=1
    )
    Path("data/small224").symlink_to("small")
    text = "\n".join(page.read_text() for page in PAGES if page.name != "README.md")
    blocks = [code for kind, code in FENCED.findall(text) if kind == "python"]
    assert len(blocks) >= 5
    for code in blocks:
        exec(compile(code.replace("num_workers=2", "num_workers=0"), "README.md", "exec"), {})
