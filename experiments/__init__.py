"""Scripts of the programs, benchmarks and studies; `python -m experiments.run --scene=table`."""

import sys

from jaxcloseup.app.cli.interrupt import end_at_ctrl_c


# `python -m` imports this package before the program itself: Ctrl-C ends both.
if sys.argv[:1] == ["-m"]:
    end_at_ctrl_c(sys.orig_argv[-len(sys.argv)])  # what is between -m and the program's arguments
