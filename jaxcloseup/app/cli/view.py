"""View a finished or interrupted run in a browser, and choose close-ups to render there.

    python -m experiments.view --run=outputs/table/surfels/...

The page shows surfels as Gaussian splats, and a NeRF as the points that it started from. A click on
the scene puts a close-up camera in front of that point; a click on a training camera moves you to
it. The run's own renderer makes the pictures below the buttons. Each visitor has a close-up camera
and pictures of their own. The program needs the extra "viewer".
"""

from absl import flags

from jaxcloseup.app.cli import view_flags as define_flags
from jaxcloseup.app.cli.start import job


flags.adopt_module_key_flags(define_flags)  # these are in --help too
flags.DEFINE_string(
    "host", "127.0.0.1", "address to serve at; the default serves this computer only"
)
flags.DEFINE_integer("port", 7007, "port to serve at", lower_bound=1, upper_bound=65535)


def main(_: list[str]) -> None:
    """Serve the run that the flags name until Ctrl-C."""
    job("view").main()
