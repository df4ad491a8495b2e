"""The program `jaxcloseup run`: `python -m experiments.run --help`."""

from jaxcloseup.app.cli import run
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(run)
