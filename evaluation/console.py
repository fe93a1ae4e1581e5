"""Printing rich tables the same way from every command."""

import os
import sys

from rich.console import Console, RenderableType

WIDTH_IN_PIPES = 140


def output_width() -> int:
    """Columns of text there are: the terminal's, those COLUMNS says, or a fixed number into pipes and files."""
    if sys.stdout.isatty() or "COLUMNS" in os.environ:
        return Console().width
    return WIDTH_IN_PIPES


def show(*parts: RenderableType) -> None:
    """Print to stdout: plain text of a fixed width into pipes and files, colours only on a terminal."""
    # A name may hold characters that the terminal's encoding lacks; a table with a mark in it beats a traceback.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")
    console = Console(width=output_width(), highlight=False, markup=False, emoji=False)
    for part in parts:
        console.print(part)
