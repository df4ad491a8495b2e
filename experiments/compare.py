"""The program `jaxcloseup compare`: `python -m experiments.compare --help`."""

from jaxcloseup.app.cli import compare
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(compare)
