"""The program `jaxcloseup process`: `python -m experiments.process --help`."""

from jaxcloseup.app.cli import process
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(process)
