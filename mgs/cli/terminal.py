"""The terminal: text is printed as it is, without markup, and names cannot control it; progress."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from mgs.errors import printable_lines
from mgs.progress import listening


class Terminal(Console):
    """Console that reads no markup in text and cells, and escapes control characters in them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, highlight=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable_lines(text), **options)


def echo(text: str) -> None:
    """Print text to the standard output, whatever its width."""
    print(printable_lines(text))


SECONDS_BETWEEN = 10.0  # least time between two lines of progress where there is no terminal


class ProgressBar:
    """Lines at the bottom of the terminal: the stage at work, and above it the whole. Without a
    terminal, a line on the standard error every SECONDS_BETWEEN."""

    def __init__(self, bar: Progress, stage: str) -> None:
        self._bar = bar
        self._printed = time.monotonic()
        self._whole: TaskID | None = None
        self._name = stage
        self._stage = bar.add_task(stage, total=None)

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None:
        """Show a stage and how far it is. total: 0 if unknown."""
        if stage != self._name:
            self._bar.remove_task(self._stage)
            self._name, self._stage = stage, self._bar.add_task(stage, total=None)
        self._bar.update(self._stage, completed=done, total=total or None)
        if self._bar.disable and time.monotonic() > self._printed + SECONDS_BETWEEN:
            self._printed = time.monotonic()
            of = f": {done} of {total}" if total > 1 else ""
            print(printable_lines(f"{stage}{of}"), file=sys.stderr, flush=True)

    def whole(self, name: str, done: int, total: int) -> None:
        if self._whole is None:
            self._whole = self._bar.add_task(name, total=total)
        self._bar.update(self._whole, completed=done, total=total)

    def print(self, text: str) -> None:
        """Print a line above the bar; it stays when the bar goes."""
        self._bar.console.print(text, soft_wrap=True, markup=False, highlight=False)


@contextmanager
def progress_bar(stage: str = "reading", console: Terminal | None = None) -> Iterator[ProgressBar]:
    """Show progress while the context is open, on a terminal or in a notebook; nothing of it stays.

    It listens to `mgs.progress.report`, and what it yields may be called as progress(stage, done,
    total)."""
    name = TextColumn("{task.description}", markup=False)
    columns = name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    console = console or Terminal()
    off = not (console.is_terminal or console.is_jupyter)  # it would leave an empty line
    with Progress(*columns, console=console, transient=True, disable=off) as bar:
        progress = ProgressBar(bar, stage)
        with listening(progress):
            yield progress
