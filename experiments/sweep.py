"""The program `jaxcloseup sweep`: `python -m experiments.sweep --help`."""

from jaxcloseup.app.cli import sweep
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(sweep)
