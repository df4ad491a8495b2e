"""The program `jaxcloseup closeup`: `python -m experiments.closeup --help`."""

from jaxcloseup.app.cli import closeup
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(closeup)
