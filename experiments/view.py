"""The program `jaxcloseup view`: `python -m experiments.view --help`."""

from jaxcloseup.app.cli import view
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(view)
