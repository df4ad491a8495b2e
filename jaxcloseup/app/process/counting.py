"""Show how far a stage is, how fast it works, and how long it will still take."""

import contextlib
import time
from collections.abc import Callable, Iterator

from jaxcloseup.app.progress import saying


Report = Callable[[int, int | None], None]  # (done, total; None if unknown)


@contextlib.contextmanager
def progress(what: str, unit: str) -> Iterator[Report]:
    """Show the progress of a stage while it works, and leave a line when it ends.

    Args:
      what: description of the stage.
      unit: unit of its progress, in the plural.

    Yields:
      A function that takes the count that is done and the total. The count of its first call was
      done before, so the rate leaves it out.
    """
    began, first, line = time.monotonic(), None, what
    with saying(what) as shown:

        def report(done: int, total: int | None) -> None:
            nonlocal first, line
            first = done if first is None else first
            rate = (done - first) / max(time.monotonic() - began, 1e-3)
            of = "" if total is None else f" of {total}"
            line = f"{what}: {done}{of}, {rate:.1f} {unit}/s"
            minutes, seconds = divmod(round((total - done) / rate) if total and rate else 0, 60)
            shown(line + (f", {minutes}:{seconds:02d} left" if minutes or seconds else ""))

        yield report
    if first is not None:
        print(line, flush=True)
