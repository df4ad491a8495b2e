"""One line for each stage: what is done, how fast, and how long it will take."""

import contextlib
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


Report = Callable[[int, int | None], None]  # (done, of how many; None where nobody knows)
_EVERY = 5.0  # seconds between lines where the output is not a terminal


@contextlib.contextmanager
def progress(what: str, unit: str) -> Iterator[Report]:
    """Show the progress of a stage, in one line of a terminal or else in a line every 5 seconds.

    Args:
      what: what the stage does.
      unit: what it counts, in the plural.

    Yields:
      A function to call with the count that is done and that of all. What its first call says was
      done before is not part of the rate.
    """
    console, began, first = Console(), time.monotonic(), None

    def rate(done: int) -> str:
        seconds = max(time.monotonic() - began, 1e-3)
        return f"{(done - (first or 0)) / seconds:.1f} {unit}/s"

    if not console.is_terminal:
        print(f"{what} ...", flush=True)
        last, said = began, (0, None)

        def report(done: int, total: int | None) -> None:
            nonlocal first, last, said
            first, said = done if first is None else first, (done, total)
            if time.monotonic() - last >= _EVERY and done != total:
                last = time.monotonic()
                print(_line(what, *said, rate(done)), flush=True)

        yield report
        if first is not None:
            print(_line(what, *said, rate(said[0])), flush=True)
        return

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    columns += [TextColumn("{task.fields[rate]}"), TimeRemainingColumn()]
    with Progress(*columns, console=console) as shown:
        task = shown.add_task(what, total=None, rate="")

        def draw(done: int, total: int | None) -> None:
            nonlocal first
            first = done if first is None else first
            shown.update(task, completed=done, total=total, rate=rate(done))

        yield draw


def _line(what, done, total, rate):
    return f"{what}: {done}{'' if total is None else f' of {total}'}, {rate}"
