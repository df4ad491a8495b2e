"""The methods by name: each module of this package that has a `METHOD` is one.

A new method is a new file here, and nothing else lists it. These modules import no JAX, so flags
can offer all methods and presets at once.
"""

import importlib
import pkgutil

from jaxcloseup.app import methods
from jaxcloseup.app.methods.method import Method


DEFAULT = "surfels"
METHODS: dict[str, Method] = {}  # modules that are found below import it


def find_methods() -> dict[str, Method]:
    """Return the methods by name, the default first."""
    names = [module.name for module in pkgutil.iter_modules(methods.__path__) if not module.ispkg]
    found = {}
    for name in sorted(names, key=lambda name: (name != DEFAULT, name)):
        module = importlib.import_module(f"{methods.__name__}.{name}")
        if hasattr(module, "METHOD"):
            found[name] = module.METHOD
    return found


METHODS.update(find_methods())
