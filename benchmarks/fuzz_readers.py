"""Mutations of valid files of every kind that comes from outside: how many are read, refused by an
error that names the file, and broke the reader, with the first few of these.

    python benchmarks/fuzz_readers.py [--mutations 2000] [--seed 0] [READER ...]

The files and mutators are those of `tests/mutations.py`. Exits with 1 where a reader broke.
"""

import argparse
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from mutations import sources, tree_outcome
from published_trees import make_tree

TREE = "published tree"
SHOWN = 5


def tree_outcomes(folder: Path, count: int, seed: int) -> Iterable[str]:
    tree = make_tree(folder / "tree", splits={"train": ("bowl",)})
    for number in range(count):
        work = folder / "work"
        work.mkdir()
        yield tree_outcome(tree, work, seed * count + number)
        shutil.rmtree(work)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mutations", type=int, default=2000, help="of each reader's file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("readers", nargs="*", metavar="READER", help="default: all")
    args = parser.parse_args()
    rows, broken = [], []
    with tempfile.TemporaryDirectory() as scratch:
        made = sources(Path(scratch))
        for name in args.readers or [*made, TREE]:
            if name == TREE:
                outcomes = tree_outcomes(Path(scratch), args.mutations, args.seed)
            else:
                outcomes = map(made[name].outcome, made[name].mutations(args.mutations, args.seed))
            listed = list(outcomes)
            counts = Counter(listed)
            faults = [outcome for outcome in listed if outcome not in ("read", "refused")]
            broken += [f"{name}: {fault[:300]}" for fault in faults[:SHOWN]]
            rows.append((name, len(listed), counts["refused"], counts["read"], len(faults)))
    print(f"{'reader':18}{'mutations':>10}{'refused':>9}{'read':>7}{'broke':>7}")
    for name, *numbers in rows:
        print(f"{name:18}{numbers[0]:10}{numbers[1]:9}{numbers[2]:7}{numbers[3]:7}")
    print("\n".join(broken))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
