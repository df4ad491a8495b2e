"""The program `jaxcloseup mesh`: `python -m experiments.mesh --help`."""

from jaxcloseup.app.cli import mesh
from jaxcloseup.app.cli.start import start


if __name__ == "__main__":
    start(mesh)
