"""The program `jaxcloseup check`: `python -m experiments.check --help`."""

from jaxcloseup.app.cli import check
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(check)
