"""Public names of a package that load their modules on first use (PEP 562).

So `import jaxcloseup` is cheap, and configurations can be read without importing JAX.
"""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package.

    Args:
      package: its `__name__`.
      modules: public names, separated by spaces, by the module within the package that defines
        them.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{package}.{module_of[name]}"), name)
        setattr(sys.modules[package], name, value)  # so it is looked up here only once
        return value

    return sorted(module_of), load, lambda: sorted(module_of)


def lazy_function(module: str, name: str) -> Callable[..., Any]:
    """Return a function of a module that is imported when the function is first called."""

    def call(*args: Any, **kwargs: Any) -> Any:
        return getattr(importlib.import_module(module), name)(*args, **kwargs)

    return call
