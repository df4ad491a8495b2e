"""The line that says what a program does now."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task
from rich.table import Column, Table
from rich.text import Text

from jaxcloseup.app.progress.estimate import Estimate


QUIET = 4.0  # seconds without a line, after which a file or a pipe gets one


class _TextColumn(ProgressColumn):
    """A column whose text is made whenever the line is drawn."""

    def __init__(self, text: Callable[[Task], str]) -> None:
        super().__init__(Column(no_wrap=True, overflow="ellipsis"))
        self.text = text

    def render(self, task: Task) -> Text:
        return Text(self.text(task))


class _Display(Progress):
    """Shows the newest task, with the part of the run and the time left of the whole run."""

    def __init__(self) -> None:
        what = [_TextColumn(self._part_text), _TextColumn(_task_text)]
        times = [_TextColumn(text) for text in (_seconds_text, self.rate_text, self.left_text)]
        self.texts, bar = [*what, *times], BarColumn(bar_width=16)
        super().__init__(*what, bar, *times, refresh_per_second=2, transient=True)
        self.estimate = Estimate({}, time.monotonic)
        self.words: Callable[[str], str] = str
        self.steps = self.add_task("getting ready", total=None)  # of the current part
        self.shown = False
        self.said = 0.0

    def get_renderables(self) -> Iterator[Table]:
        """Draw the newest task alone: one line."""
        yield self.make_tasks_table(self.tasks[-1:])

    def say(self) -> None:
        """Print the line, unless a terminal shows it anyway."""
        if self.shown and not self.live.is_started:
            self.said, task = time.monotonic(), self.tasks[-1]
            texts = (column.text(task) for column in self.texts)
            sys.stdout.write(", ".join(filter(None, texts)) + "\n")
            sys.stdout.flush()

    @contextlib.contextmanager
    def show(self) -> Iterator[None]:
        """Show the line at the bottom of a terminal, or print it after every `QUIET` seconds."""
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(0.2):
                if time.monotonic() - self.said >= QUIET:
                    self.say()

        self.shown, self.said = True, time.monotonic()
        try:
            if sys.stdout.isatty():
                self.live.console = Console()  # knows what stdout is now, not at the import
                with self:
                    yield
            else:
                threading.Thread(target=watch, daemon=True).start()
                yield
        finally:
            ended.set()
            self.shown = False

    @contextlib.contextmanager
    def task(self, description: str, total: int | None = None) -> Iterator[Any]:
        """Show a task; yields its number."""
        number = self.add_task(description, total=total)
        try:
            yield number
        finally:
            self.remove_task(number)
            self.reset(self.tasks[0].id)  # its seconds begin again

    def numbered(self, name: str) -> str:
        """Return a part's name after its number in the plan, as in `[3/19] baseline`."""
        place = self.estimate.place
        return name if place is None else f"[{place[0]}/{place[1]}] {name}"

    def rate_text(self, task: Task | None = None) -> str:
        """Return the steps per second of the current part, or "" if they are unknown."""
        return f"{self.estimate.rate:.1f} steps/s" if self.estimate.rate else ""

    def left_text(self, task: Task | None = None) -> str:
        """Return the time left of the run, or "" if it is unknown."""
        left = self.estimate.left()
        if left is None:
            return ""
        minutes, seconds = divmod(round(left), 60)
        return f"{minutes}:{seconds:02d} left"

    def _part_text(self, task: Task) -> str:
        name, done = self.estimate.name, self.estimate.done
        if name is None:
            return ""
        steps = "" if done is None else f", {done} of {self.estimate.total} steps"
        return self.numbered(self.words(name)) + steps


def _task_text(task: Task) -> str:
    if not task.description or task.total is None:
        return task.description
    return f"{task.description}: {task.completed:.0f} of {task.total:.0f}"


def _seconds_text(task: Task) -> str:
    counts_steps = not task.description and task.total is not None
    seconds = task.elapsed or 0.0
    return "" if counts_steps or seconds < 1 else f"{seconds:.0f} s"


_display = _Display()


@contextlib.contextmanager
def showing(
    plan: Mapping[str, float] | None = None,
    *,
    words: Callable[[str], str] = str,
    compiled: Callable[[], float] = lambda: 0.0,
) -> Iterator[None]:
    """Show the progress of the body; an inner plan takes the place of an outer one.

    Args:
      plan: typical seconds of each part by its name, in order.
      words: returns the words for a part.
      compiled: returns the seconds of compiling so far.
    """
    before = _display.estimate, _display.words
    _display.estimate = Estimate(plan or {}, lambda: time.monotonic() - compiled())
    _display.words = words
    try:
        with contextlib.nullcontext() if _display.shown else _display.show():
            yield
    finally:
        _display.estimate, _display.words = before


@contextlib.contextmanager
def part(name: str) -> Iterator[None]:
    """Show the body as a part of the run; a part inside a part is not shown."""
    estimate = _display.estimate
    if estimate.name is not None:
        yield
        return
    estimate.begin(name)
    try:
        with _display.task("") as number:
            _display.steps = number
            _display.say()
            yield
    finally:
        estimate.end()


@contextlib.contextmanager
def saying(what: str) -> Iterator[Callable[[str], None]]:
    """Show at once what the body does; yields a function that replaces the text."""
    with _display.task(what) as number:
        _display.say()
        yield lambda text: _display.update(number, description=text)


def track(values: Sequence[Any], what: str) -> Iterator[Any]:
    """Yield values, and show how many are done."""
    with _display.task(what, total=len(values)) as number:
        if _display.estimate.name is None:  # otherwise the part has said that it begins
            _display.say()
        for value in values:
            yield value
            _display.advance(number)


def count(name: str, done: int, total: int) -> str:
    """Count steps of the current part; the first call sets where it begins.

    Returns:
      A line for the caller to print: the name with its number in the plan, the steps, steps per
      second without compiling, and the time left of the run.
    """
    estimate, text = _display.estimate, f"{name} {done:>{len(str(total))}}/{total}"
    if estimate.name is None:
        return text
    estimate.count(done, total)
    _display.update(_display.steps, completed=done, total=total)
    _display.said = time.monotonic()
    texts = _display.numbered(text), _display.rate_text(), _display.left_text()
    return "  ".join(filter(None, texts))
