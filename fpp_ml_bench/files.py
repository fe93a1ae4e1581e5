"""Files of any room: text of unknown origin, the only readers of YAML and JSON from outside,
bounded reading, atomic writing, hashes, and locks."""

import errno
import json
import os
import re
import shutil
import stat
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import accumulate
from pathlib import Path, PurePosixPath
from secrets import token_hex
from typing import IO, Any

from fpp_ml_bench.errors import BuildError, FppBenchError, PredictionError

NAME_LIMIT, PATH_LIMIT = 200, 500
"""Longest text a submission may hold in any one value, in characters."""
DEEPEST, LONGEST_NUMBER, MOST_NODES, MOST_VALUES = 64, 1_000, 50_000, 1_000_000
"""Limits of a file from outside, checked before its values are built: levels of mappings and lists
in each other, digits of a number, keys and values of YAML, values of JSON."""
LARGEST = 1e100
"""Magnitude of a number in a file from outside, at most: sums, products and ratios of such numbers
stay finite, and no length, time or count comes near."""
CORRECT = "correct the file"
_PIECE_BYTES = 1 << 18  # of a file that is hashed, at a time: they stay in the processor's cache

# Control, format (bidirectional overrides, zero-width), surrogate, and line or paragraph
# separators.
_FORBIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def text_problem(value: str, limit: int = NAME_LIMIT) -> str | None:
    """What is wrong with a one-line text, or None: empty, over ``limit`` characters, or with
    control characters."""
    if not value.strip():
        return "expected some text, got an empty one"
    if len(value) > limit:
        return f"expected at most {limit} characters, got {len(value)}"
    bad = next((c for c in value if unicodedata.category(c) in _FORBIDDEN), None)
    if bad is not None:
        return f"expected printable text, got the control character U+{ord(bad):04X}"
    return None


def path_problem(path: str) -> str | None:
    """What is wrong with a text from a file that must be the path of something below a folder, or
    None."""
    plain = PurePosixPath(path)
    below = plain.parts and not plain.is_absolute() and ".." not in plain.parts and "\\" not in path
    if below and str(plain) == path:
        return text_problem(path)
    return "expected a relative path with / between its names, and without . and .."


def cause_of(error: Exception) -> str:
    """An error as text, that of the operating system without its number and path."""
    return getattr(error, "strerror", None) or str(error)


def printable(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` as text that is safe in a terminal: control characters escaped, cut at ``limit``
    characters, a path at `PATH_LIMIT`."""
    if isinstance(value, Path):
        value, limit = str(value), PATH_LIMIT
    text = value if isinstance(value, str) else repr(value)
    escaped = "".join(
        c
        if unicodedata.category(c) not in _FORBIDDEN
        else c.encode("unicode_escape", "backslashreplace").decode()
        for c in text[:limit]
    )
    return escaped + ("..." if len(text) > limit else "")


def first_of(names: Sequence[str], most: int) -> str:
    """The first ``most`` names as text, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


@contextmanager
def opened(path: Path, links: bool = False) -> Iterator[tuple[IO[bytes], int]]:
    """The file and its size in bytes; PredictionError, without the file's name, for anything but a
    regular file, and without ``links`` for a symbolic link. Opening never waits, as for the other
    end of a pipe."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | (0 if links else os.O_NOFOLLOW))
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        linked = not links and path.is_symlink()
        reason = (
            "is a symbolic link; put the file itself there"
            if linked
            else f"can't be read: {cause_of(error)}"
        )
        raise PredictionError(reason) from None
    info = os.fstat(descriptor)
    if not stat.S_ISREG(info.st_mode):
        os.close(descriptor)
        what = " but a folder" if stat.S_ISDIR(info.st_mode) else ""
        raise PredictionError(f"is not a regular file{what}; put the file itself there")
    with os.fdopen(descriptor, "rb", buffering=0) as stream:
        yield stream, info.st_size


def visible(folder: Path, raised: type[FppBenchError]) -> list[Path]:
    """The entries of a folder by name, but those whose name begins with a dot. Raises ``raised``
    for a folder that can't be read."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise raised(f"{folder}: can't be read ({cause_of(error)})") from error


def is_file(path: Path) -> bool:
    """Whether there is a file; False for a name that no file can have, for which ``Path.is_file``
    raises an error."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def fill(stream: IO[Any], view: memoryview) -> int:
    """Fill ``view`` from the stream; the number of bytes read, fewer where the stream ends
    early."""
    done = 0
    while count := stream.readinto(view[done:]):  # type: ignore[attr-defined]
        done += count
    return done


def read_bounded(
    path: Path, limit: int, cure: str = "write a map of this size again", links: bool = False
) -> bytes:
    """All bytes of the file at ``path``. Raises PredictionError as `opened`, or when they are more
    than ``limit``."""
    with opened(path, links) as (stream, size):
        if size > limit:
            raise PredictionError(f"has {size} bytes, expected at most {limit} bytes; {cure}")
        content = bytearray(size)
        length = fill(stream, memoryview(content))
    if length != size:
        raise PredictionError(f"ended early: expected {size} bytes, got {length}; {cure}")
    return bytes(content)


def file_content(path: Path, limit: int, raised: type[FppBenchError], cure: str = CORRECT) -> bytes:
    """All bytes, at most ``limit``, of a file that the user names; a link is followed. Raises
    ``raised`` with the file's name, the problem and the ``cure``."""
    try:
        return read_bounded(path, limit, cure, links=True)
    except PredictionError as error:
        raise raised(f"{printable(str(path), 500)}: {error}") from None


def read_yaml(
    path: Path, raised: type[FppBenchError], cure: str = CORRECT, limit: int = 1 << 20
) -> Any:
    """The plain values of a YAML file, as `strict_yaml`; ``raised`` with file, problem and
    ``cure``."""
    return _read(path, strict_yaml, "plain YAML", raised, cure, limit)


def read_json(path: Path, raised: type[FppBenchError], cure: str = CORRECT) -> Any:
    """The plain values of a JSON file, as `strict_json`; ``raised`` with file, problem and
    ``cure``."""
    return _read(path, strict_json, "valid JSON", raised, cure, 1 << 26)


def _read(
    path: Path,
    parse: Callable[[str], Any],
    form: str,
    raised: type[FppBenchError],
    cure: str,
    limit: int,
) -> Any:
    content, file = file_content(path, limit, raised, cure), printable(str(path), 500)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise raised(f"{file}: expected UTF-8 text, found other bytes; {cure}") from None
    try:
        return parse(text)
    except ValueError as error:
        raise raised(f"{file} is no {form}: {error}; {cure}") from None


DISK_FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have an `OSError` within name ``path``, and that of a full disk, which names no file, say
    what to do."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        if error.errno in DISK_FULL:
            error.strerror = f"{os.strerror(error.errno)}; free some space or choose another disk"
        raise


UNFINISHED = r"\.[0-9a-f]{16}\.tmp"
"""Pattern of the name of a file that is not yet complete, which a killed process may leave."""


@contextmanager
def whole_file(path: Path, sync: bool = True) -> Iterator[IO[bytes]]:
    """A new file to be written within, which becomes ``path`` at the end, and is removed after an
    error: it is there complete or not at all, with ``sync`` (which takes milliseconds) also after a
    power cut. Its name until then can't be guessed, and no link is followed: in a folder that
    others write to, nobody can plant one. An `OSError` names ``path``."""
    temporary = path.with_name(f".{token_hex(8)}.tmp")
    with naming(path):
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                if sync:
                    os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes, sync: bool = True) -> None:
    """Write ``content`` as a `whole_file`."""
    with whole_file(path, sync) as file:
        file.write(content)


@contextmanager
def whole_folder(
    out: Path, activity: str, error_type: type[FppBenchError], empty: str = "give a new folder"
) -> Iterator[Path]:
    """A folder to write into, which becomes ``out`` when the block succeeds, and is removed when it
    fails. What a killed process left of one is removed. Raises ``error_type`` where ``out`` is not
    empty (with what to do then), is a file, is being written by another process, or can't be
    written."""
    target = out.resolve()
    if target.is_dir() and any(target.iterdir()):
        raise error_type(f"{out}: is not empty; {empty}")
    staging = target.with_name(f".{target.name}.unfinished")
    if staging.is_symlink():
        raise error_type(
            f"{staging}: is a link, and this command needs a folder of that name; remove it"
        )
    with exclusive(staging / LOCK_FILE, out, activity, error_type):
        content = staging / "files"
        try:
            shutil.rmtree(content, ignore_errors=True)
            content.mkdir()
            yield content
            content.replace(target)
        except OSError as error:
            raise error_type(
                f"{out}: can't be written ({error.strerror or error}); nothing was left there. "
                f"Free some "
                "space or choose another disk"
            ) from error
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def write_files(
    folder: Path, contents: Mapping[str, bytes], error_type: type[FppBenchError]
) -> list[Path]:
    """Write ``contents`` by file name into ``folder``, which is made if it is missing; returns
    their paths. Raises ``error_type`` for a folder that can't be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise error_type(
            f"{folder}: can't be written ({error.strerror or error}); choose another folder"
        ) from error
    return [folder / name for name in contents]


def holds(folder: Path, contents: Mapping[str, bytes]) -> bool:
    """Whether ``folder`` holds exactly the files ``contents``, by name."""
    if not folder.is_dir() or {path.name for path in folder.iterdir()} != contents.keys():
        return False
    try:
        return all(
            read_bounded(folder / name, len(content)) == content
            for name, content in contents.items()
        )
    except PredictionError:  # longer, or no file
        return False


def file_hash(path: Path) -> str:
    """XXH3 128-bit hash of a file's bytes, hex. Read and not mapped: a file that is cut meanwhile
    has another hash, and would end a process that maps it."""
    import xxhash

    digest, piece = xxhash.xxh3_128(), memoryview(bytearray(_PIECE_BYTES))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(piece):
            digest.update(piece[:count])
    return digest.hexdigest()


def check_space(needed: Mapping[Path, int], needing: str, cure: str) -> None:
    """Raise `BuildError` for a disk that has less free space than all folders on it need, in bytes.
    ``needing``: what needs them, and the verb."""
    places, sizes = dict[int, Path](), Counter[int]()
    for folder, size in needed.items():
        there = next(
            parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists()
        )
        sizes[there.stat().st_dev] += size
        places.setdefault(there.stat().st_dev, there)
    for device, size in sizes.items():
        there = places[device]
        if size > (free := shutil.disk_usage(there).free):
            raise BuildError(
                f"{there}: the disk has {free / 1e9:.2f} GB free, and {needing} about "
                f"{size / 1e9:.2f} GB there; "
                f"free some space, or choose another disk{cure}"
            )


LOCK_FILE = ".lock"
"""Of a folder that a process works in. One that a killed process left locks nothing."""


@contextmanager
def exclusive(
    lock_file: Path, folder: Path, activity: str, error_type: type[FppBenchError] = BuildError
) -> Iterator[None]:
    """Hold ``lock_file``, created with its folder if absent and removed at the end; ``error_type``
    for a ``folder`` that is a file, can't be written or that another process has. The operating
    system releases the lock when the process ends in any way."""
    import filelock

    if folder.exists() and not folder.is_dir():
        raise error_type(f"{folder}: is a file; give a folder")
    lock, made = filelock.FileLock(lock_file, timeout=0), not lock_file.parent.exists()
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        raise error_type(
            f"{folder}: another process is {activity}; wait for it or choose another folder"
        ) from None
    except OSError as error:
        raise error_type(f"{folder}: can't be written ({error.strerror or error})") from error
    held = lock_file.stat()
    try:
        yield
    finally:
        with suppress(OSError):
            if os.path.samestat(held, lock_file.stat()):  # the folder may have been moved away
                lock_file.unlink()  # while it is held: filelock never takes a file that is gone
                if made:
                    lock_file.parent.rmdir()  # where nothing was written into it
        lock.release()


@cache
def _strict_loader() -> type:
    import yaml

    class StrictLoader(yaml.SafeLoader):
        """SafeLoader without aliases, tags and duplicate keys, of bounded size, with 1e-3 read as
        the number it is and 2026-01-31 as text."""

        nodes = depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            event, key = (
                self.peek_event(),
                f" {printable(index.value, 60)}:" if hasattr(index, "value") else "",
            )
            where = f"line {event.start_mark.line + 1}:{key}"
            if isinstance(event, yaml.events.AliasEvent):
                raise yaml.YAMLError(f"{where} uses an alias (*); write the value out")
            if event.tag is not None:
                raise yaml.YAMLError(
                    f"{where} has the tag {printable(event.tag, 60)}; write a plain value"
                )
            self.nodes, self.depth = self.nodes + 1, self.depth + 1
            if self.nodes > MOST_NODES:
                raise yaml.YAMLError(f"{where} expected at most {MOST_NODES} keys and values")
            if self.depth > DEEPEST:
                raise yaml.YAMLError(
                    f"{where} nested too deeply, expected at most {DEEPEST} levels"
                )
            node: Any = super().compose_node(parent, index)
            self.depth -= 1
            if (
                node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
                and len(node.value) > LONGEST_NUMBER
            ):
                raise yaml.YAMLError(f"{where} a number of more than {LONGEST_NUMBER} digits")
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            seen = set()
            for key, _ in node.value:
                if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                    raise yaml.YAMLError(f"line {key.start_mark.line + 1}: expected text as key")
                if key.value in seen:
                    line, name = key.start_mark.line + 1, printable(key.value, 60)
                    raise yaml.YAMLError(f"line {line}: key {name!r} is given twice")
                seen.add(key.value)
            return super().construct_mapping(node, deep=deep)

    StrictLoader.yaml_implicit_resolvers = {
        first: [rule for rule in rules if rule[0] != "tag:yaml.org,2002:timestamp"]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    StrictLoader.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"),
        list("-+0123456789"),
    )
    return StrictLoader


def strict_yaml(text: str) -> Any:
    """The plain values of a YAML text. Raises ValueError, fit to print, for anything else: also for
    an alias, a tag, a key given twice, a number beyond `LARGEST`, and for more or deeper values
    than `MOST_NODES` and `DEEPEST`."""
    import yaml

    try:
        content = yaml.load(
            text, _strict_loader()
        )  # a subclass of SafeLoader: builds plain values only
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        lines = str(error).replace('"<unicode string>", ', "").splitlines()
        raise ValueError(" ".join(printable(line.strip()) for line in lines)) from None
    _check_values(content)
    return content


_JSON_TEXT = re.compile(r'"(?:[^"\\]|\\.)*+"', re.DOTALL)


def strict_json(text: str) -> Any:
    """The plain values of a JSON text. Raises ValueError, fit to print, for anything else: also for
    a key given twice, NaN, a number beyond `LARGEST`, and for more or deeper values than
    `MOST_VALUES` and `DEEPEST`."""
    if not text.strip():
        raise ValueError("it is empty")
    bare = _JSON_TEXT.sub("", text)
    if sum(map(bare.count, ",[{")) >= MOST_VALUES:
        raise ValueError(f"expected at most {MOST_VALUES} values")
    steps = (1 if bracket in "[{" else -1 for bracket in re.sub(r"[^][{}]+", "", bare))
    if max(accumulate(steps), default=0) > DEEPEST:
        raise ValueError(f"nested too deeply, expected at most {DEEPEST} levels")
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_int=_whole)
    except RecursionError:  # under a deep stack
        raise ValueError("nested too deeply") from None
    except ValueError as error:
        raise ValueError(printable(str(error))) from None
    _check_values(content)
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"key {printable(key, 60)!r} is given twice")
        content[key] = value
    return content


def _whole(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(f"a number of more than {LONGEST_NUMBER} digits")
    return int(text)


def _check_values(value: Any, where: str = "") -> None:
    """Refuse what neither format can say but its readers accept: NaN, half a character; numbers
    beyond `LARGEST`."""
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_values(key, where)
            _check_values(entry, (f"{where}.{key}" if where else key)[:NAME_LIMIT])
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            _check_values(entry, f"{where}[{index}]")
    elif isinstance(value, int | float) and not abs(value) <= LARGEST:
        number = printable(json.dumps(value), 60)
        raise ValueError(
            f"{printable(where) or 'the file'}: {number} is no number; expected a finite one up to "
            f"{LARGEST:g}"
        )
    elif (
        isinstance(value, str)
        and not value.isascii()
        and any("\ud800" <= letter <= "\udfff" for letter in value)
    ):
        raise ValueError(
            f"{printable(where) or 'the file'}: half of a surrogate pair; write the character "
            f"itself"
        )
