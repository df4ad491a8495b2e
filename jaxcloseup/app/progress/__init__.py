"""Show what a program does now, and how long the whole of it still takes.

A terminal shows one line at the bottom. Other outputs get a line when something begins, and another
after every few seconds of silence, so that nobody takes a long compilation for a hang. Without
`showing`, as in tests of single functions, nothing is shown.
"""

from jaxcloseup.app.progress.display import count, part, saying, showing, track
from jaxcloseup.app.progress.threads import each, workers


__all__ = ["count", "each", "part", "saying", "showing", "track", "workers"]
