"""The line that says what a program does now."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from jaxcloseup.app.progress.estimate import Estimate


QUIET = 4.0  # seconds without a line, after which a file or a pipe gets one
_display: "_Display | None" = None


class _Display:
    """The state of the line. A thread shows it while the program computes."""

    def __init__(self, estimate: Estimate, words: Callable[[str], str]) -> None:
        self.estimate, self._words = estimate, words
        self.lock = threading.RLock()  # of the estimate
        self.doing: list[list[str]] = []  # a text each, the innermost last
        self.said = time.monotonic()
        self._began = self.said  # what is being done

    def line(self) -> str:
        """What is done, for how long, and how long the run still takes."""
        with self.lock:
            parts = []
            if self.estimate.name is not None:
                parts.append(_numbered(self.estimate, self._words(self.estimate.name)))
                if self.estimate.done is not None:
                    parts.append(f"{self.estimate.done} of {self.estimate.total} steps")
            remaining = _left(self.estimate)
            counting = self.estimate.done is not None
        parts += (self.doing or [[] if parts else ["getting ready"]])[-1]
        seconds = time.monotonic() - self._began
        if seconds >= 1 and (self.doing or not counting):
            parts.append(f"{seconds:.0f} s")
        return ", ".join([*parts, *remaining])

    def changed(self, *, aloud: bool) -> None:
        """Begin to time what is done now; say it where no terminal shows the line anyway."""
        self._began = time.monotonic()
        if aloud and not _is_terminal():
            self.say()

    def say(self) -> None:
        """Print the line."""
        self.said = time.monotonic()
        sys.stdout.write(f"{self.line()}\n")
        sys.stdout.flush()

    def watch(self, ended: threading.Event) -> None:
        """Say the line whenever nothing was said for `QUIET` seconds."""
        while not ended.wait(0.2):
            if _display is self and time.monotonic() - self.said >= QUIET:
                self.say()


def _is_terminal() -> bool:
    return sys.stdout.isatty()


def _numbered(estimate, name):
    """A part's name after its number in the plan, as in `[3/19] baseline`."""
    return name if estimate.place is None else "[{}/{}] {}".format(*estimate.place, name)


def _left(estimate):
    """`["7:54 left"]`; nothing where nothing tells it."""
    if (seconds := estimate.left()) is None:
        return []
    minutes, seconds = divmod(round(seconds), 60)
    return [f"{minutes}:{seconds:02d} left"]


@contextlib.contextmanager
def showing(
    plan: Mapping[str, float] | None = None,
    *,
    words: Callable[[str], str] = str,
    compiled: Callable[[], float] = lambda: 0.0,
) -> Iterator[None]:
    """Show what the body does.

    Args:
      plan: typical seconds of each part by its name, in order.
      words: what a part of a name does.
      compiled: seconds that went to compiling so far.
    """
    global _display
    outer, _display = _display, _Display(Estimate(plan or {}, compiled=compiled), words)
    display, ended = _display, threading.Event()
    try:
        if _is_terminal() and outer is not None:
            yield  # its line shows this now
        elif _is_terminal():
            line = Live(
                console=Console(),
                get_renderable=lambda: Text(_display.line(), no_wrap=True, overflow="ellipsis"),
                refresh_per_second=2,
                transient=True,
            )
            with line:
                yield
        else:
            thread = threading.Thread(target=display.watch, args=(ended,), daemon=True)
            thread.start()
            yield
    finally:
        ended.set()
        _display = outer


@contextlib.contextmanager
def part(name: str) -> Iterator[None]:
    """The body is a part of the run."""
    display = _display
    if display is None or display.estimate.name is not None:
        yield
        return
    with display.lock:
        display.estimate.begin(name)
    display.changed(aloud=True)
    try:
        yield
    finally:
        with display.lock:
            display.estimate.end()
        display.changed(aloud=False)


@contextlib.contextmanager
def saying(what: str) -> Iterator[list[str]]:
    """Say at once what the body does; yields a list of the text, which the body may replace."""
    with _doing(what, aloud=True) as text:
        yield text


@contextlib.contextmanager
def _doing(what, *, aloud):
    text = [what]
    if _display is None:
        yield text
        return
    doing = _display.doing
    doing.append(text)
    _display.changed(aloud=aloud)
    try:
        yield text
    finally:
        # Another thread may have begun something since then.
        doing[:] = [one for one in doing if one is not text]


def track(values: Iterable[Any], what: str, total: int | None = None) -> Iterator[Any]:
    """Go through values, and show how many are done.

    Args:
      values: any.
      what: what is done with them.
      total: how many there are; by default their length.
    """
    if _display is None:
        yield from values
        return
    display, total = _display, total or len(values)
    aloud = display.estimate.name is None  # parts say that they begin
    with _doing(what, aloud=aloud) as text:
        for done, value in enumerate(values):
            text[0] = f"{what}: {done} of {total}"
            yield value


def count(name: str, done: int, total: int) -> str:
    """Count steps of the current part; the first call says with how many it begins.

    Returns:
      For a line of the caller: the name with its number in the plan, the steps, how many of them a
      second takes without compiling, and the time that is left of the run.
    """
    display, steps = _display, f"{done:>{len(str(total))}}/{total}"
    if display is None:
        return f"{name} {steps}"
    with display.lock:
        display.estimate.count(done, total)
        rate, remaining = display.estimate.rate, _left(display.estimate)
        shown = [f"{_numbered(display.estimate, name)} {steps}"]
    display.said = time.monotonic()
    return "  ".join(shown + ([f"{rate:.1f} steps/s"] if rate else []) + remaining)


def skip(*names: str) -> None:
    """Take parts that will not come out of the plan."""
    if _display is not None:
        with _display.lock:
            _display.estimate.skip(*names)
