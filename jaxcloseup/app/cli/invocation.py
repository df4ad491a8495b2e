"""How the user started a program: errors and printed commands repeat it."""

import itertools
import sys


def _module_after_m() -> str:
    """Return the module that `python -m` runs; empty without it."""
    words = itertools.pairwise(sys.orig_argv)
    return next((module for word, module in words if word == "-m"), "")


def program_name(program: str) -> str:
    """Return what errors of a program begin with: `jaxcloseup run` or `experiments.run`."""
    if _module_after_m().startswith("experiments."):
        return f"experiments.{program}"
    return f"jaxcloseup {program}"


def program_command(program: str) -> list[str]:
    """Return the words that start a program, without its flags, as the user gives them."""
    if _module_after_m().startswith("experiments."):
        return ["python", "-m", f"experiments.{program}"]
    if _module_after_m() == "jaxcloseup":
        return ["python", "-m", "jaxcloseup", program]
    return ["jaxcloseup", program]
