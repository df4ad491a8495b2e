"""End a program at Ctrl-C.

Ctrl-C ends a program at once, also while it imports or compiles: files are written under other
names first, so nothing is half-written, and `--resume` goes on from the last checkpoint. Python
itself would wait until a step or a compilation ends, and raise an exception wherever it is then.
"""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable


STOPPED = 130  # exit code after Ctrl-C
_say: Callable[[], str] = lambda: "stopped"  # noqa: E731


def when_stopped(say: Callable[[], str]) -> None:
    """Set what Ctrl-C does before it ends the program: return the rest of its last sentence."""
    global _say
    _say = say


def _watch(wakeups: socket.socket, program: str) -> None:
    """End the program at the first SIGINT; other signals wake the thread too."""
    while wakeups.recv(1) != bytes([signal.SIGINT]):
        pass
    try:
        sentence = _say()
    except Exception:
        sentence = "stopped"
    # What was printed before comes first, unless nobody reads it.
    flush = threading.Thread(target=sys.stdout.flush, daemon=True)
    flush.start()
    flush.join(timeout=1)
    # A progress line hides the cursor, and stands for sys.stderr meanwhile.
    shown = "\033[?25h\n" if os.isatty(2) else ""
    os.write(2, f"{shown}{program}: {sentence}\n".encode())
    os._exit(STOPPED)


def end_at_ctrl_c(program: str) -> None:
    """End the program at Ctrl-C from now on, with a sentence that begins with its name.

    A shell that starts programs in the background lets them ignore Ctrl-C, and so does this.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    wakeups, wakes = socket.socketpair()
    wakes.setblocking(False)
    # The main thread waits meanwhile: it would miss the unfinished files that are removed.
    signal.signal(signal.SIGINT, lambda *_: threading.Event().wait())
    signal.set_wakeup_fd(wakes.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(wakeups, program), daemon=True).start()
