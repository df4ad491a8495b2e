"""Sharp close-ups of scenes that were only photographed from afar."""

from jaxcloseup.version import __version__


__all__ = ["__version__"]
