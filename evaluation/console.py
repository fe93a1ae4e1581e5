"""Printing rich tables the same way from every command."""

import os
import sys

from rich.console import Console, RenderableType

WIDTH_IN_PIPES = 140


def show(*parts: RenderableType) -> None:
    """Print to stdout: plain text of a fixed width into pipes and files, colours only on a terminal."""
    # A name may hold characters that the terminal's encoding lacks; a table with a mark in it beats a traceback.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDTH_IN_PIPES
    console = Console(width=width, highlight=False, markup=False, emoji=False)
    for part in parts:
        console.print(part)
