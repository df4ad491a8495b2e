"""What a stage has done, how fast, and how long it will still take."""

import contextlib
import time
from collections.abc import Callable, Iterator

from jaxcloseup.app.progress import saying


Report = Callable[[int, int | None], None]  # (done, of how many; None where nobody knows)


@contextlib.contextmanager
def progress(what: str, unit: str) -> Iterator[Report]:
    """Show the progress of a stage while it works, and leave a line when it ends.

    Args:
      what: what the stage does.
      unit: what it counts, in the plural.

    Yields:
      A function to call with the count that is done and that of all. What its first call says was
      done before is not part of the rate.
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
            shown[0] = line + (f", {minutes}:{seconds:02d} left" if minutes or seconds else "")

        yield report
    if first is not None:
        print(line, flush=True)
