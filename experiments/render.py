"""The program `jaxcloseup render`: `python -m experiments.render --help`."""

from jaxcloseup.app.cli import render
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(render)
