"""Tables of text, which pages, Markdown files and terminals show."""

from collections.abc import Sequence
from typing import NamedTuple

import rich.table
from rich.console import Console
from rich.markup import escape


class Table(NamedTuple):
    """A table of text."""

    title: str  # what it shows
    header: Sequence[str]  # its first row
    rows: Sequence[Sequence[str]]  # the other rows
    names: int = 1  # number of columns at the left, 1 or 2, that hold no numbers


def format_number(value: float | None, pattern: str = "{:.2f}") -> str:
    """Format a number; "-" stands for an unknown one."""
    return "-" if value is None else pattern.format(value)


def markdown(table: Table) -> str:
    """Return the lines of a table in Markdown, without its title."""
    lines = [table.header, ["---"] * len(table.header), *table.rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def print_tables(tables: Sequence[Table], sentence: str = "") -> None:
    """Print tables under their titles, and a sentence."""
    console = Console()
    for table in tables:
        shown = rich.table.Table(title=escape(table.title), title_justify="left")
        for i, name in enumerate(table.header):
            # The first column is never cut, however narrow the terminal is.
            shown.add_column(escape(name), no_wrap=not i, justify="right" if i else "left")
        for row in table.rows:
            shown.add_row(*map(escape, row))
        console.print(shown)
    if sentence:
        console.print(sentence, highlight=False, markup=False)
