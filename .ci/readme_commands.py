"""Print the shell commands of one README block: the fenced block after ``<!-- ci: NAME -->``."""

import re
import sys
from pathlib import Path

name = sys.argv[1]
readme = (Path(__file__).resolve().parent.parent / "README.md").read_text(encoding="utf-8")
block = re.search(
    rf"<!-- ci: {re.escape(name)} -->\n+```(?:bash|sh)?\n(.*?)```", readme, flags=re.DOTALL
)
if block is None:
    sys.exit(f"README.md has no block marked <!-- ci: {name} -->")
sys.stdout.write(block.group(1))
