"""The program `jaxcloseup evaluate`: `python -m experiments.evaluate --help`."""

from jaxcloseup.app.cli import evaluate
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(evaluate)
