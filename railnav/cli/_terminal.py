"""What a verb shows: tables on stdout, JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import click

from railnav.io.store_address import redacted
from railnav.run import Progress

#: Width of tables where there is no terminal to ask.
PIPE_WIDTH = 160


def plain(value: Any) -> Any:
    """Turn a value into what JSON can hold: numpy to Python, NaN and infinities to null, the rest to text.

    Examples
    --------
    >>> plain({"rms": float("nan"), "tracks": ("80R", "80L")})
    {'rms': None, 'tracks': ['80R', '80L']}
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return redacted(str(value))


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout."""
    click.echo(json.dumps(plain(value), ensure_ascii=False, allow_nan=False, indent=2))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, left: int = 1) -> None:
    """Print a table on stdout: the first `left` columns are words, the others figures aligned right.

    A column whose cells are all empty is left out; without rows nothing is printed.
    """
    if not rows:
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    shown = [k for k in range(len(columns)) if any(str(row[k]) for row in rows)]
    for k in shown:
        table.add_column(columns[k], justify="left" if k < left else "right")
    for row in rows:
        table.add_row(*(str(row[k]) for k in shown))
    console = Console(file=sys.stdout, highlight=False, markup=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
    console.print(table)


def print_facts(title: str, facts: Mapping[str, object]) -> None:
    """Print a title and a list of facts on stdout; empty ones are left out."""
    click.secho(redacted(title), bold=True)
    shown = {key: str(value) for key, value in facts.items() if str(value)}
    width = max((len(key) for key in shown), default=0)
    for key, value in shown.items():
        click.echo(f"  {key:<{width}}  {value}")


def print_warnings(warnings: Sequence[str]) -> None:
    """Print warnings on stderr, one line each."""
    for warning in warnings:
        click.echo(f"railnav: warning: {' '.join(str(warning).split())}", err=True)


@contextmanager
def progress() -> Iterator[Progress | None]:
    """Show bars on stderr for the stages a long call reports; None, and silence, when stderr is not a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    bars = Bars(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
    )
    stages: dict[str, TaskID] = {}

    def report(stage: str, done: int, total: int) -> None:
        if stage not in stages:
            stages[stage] = bars.add_task(stage, total=total)
        bars.update(stages[stage], completed=done, total=total)

    with bars:
        yield report
