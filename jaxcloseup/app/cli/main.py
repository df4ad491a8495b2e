"""The command `jaxcloseup`: its first word names a program, and the rest are the program's flags.

    jaxcloseup run --scene=table

works from any folder.
"""

import importlib
import os
import sys

from jaxcloseup.app.cli.interrupt import end_at_ctrl_c
from jaxcloseup.app.cli.invocation import program_name


PROGRAMS = {
    "closeup": "from photographs to close-ups and a page that shows them, in one command",
    "run": "train on one scene, fine-tune on pseudo-labeled close-ups, evaluate, report",
    "sweep": "the same for several arms, seeds and scenes, and compare them",
    "render": "render a camera path of a run, or fine-tune for target cameras",
    "mesh": "write the surface of a run as a colored mesh",
    "export": "write splats and cameras as files that other programs read",
    "view": "look at a run in a browser, and choose close-ups there",
    "compare": "compare several finished runs on one scene",
    "evaluate": "score a folder of images against another",
    "check": "check whether a capture's poses, lenses and points fit its photographs",
    "process": "make a capture with poses from photographs or a video",
}


def main() -> None:
    """Run the program that the command line names."""
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help", "help"):
        _print_usage()
        return
    if name == "doctor":
        from jaxcloseup.app.cli.doctor import describe

        print(describe())
        return
    if name not in PROGRAMS:
        sys.exit(f"jaxcloseup: {name} is not a program: choose {', '.join(_listed())}")
    end_at_ctrl_c(program_name(name))
    from jaxcloseup.app.cli.start import start

    program = importlib.import_module(f"jaxcloseup.app.cli.{name}")
    sys.argv = [f"jaxcloseup {name}", *rest]
    start(program)


def _listed() -> dict[str, str]:
    return PROGRAMS | {"doctor": "print versions, devices, the native library and the extras"}


def _print_usage() -> None:
    width = max(map(len, PROGRAMS))
    usage = "usage: jaxcloseup PROGRAM [--flag=value ...]; `jaxcloseup PROGRAM --help` has flags\n"
    programs = [f"  {program:{width}}  {what}" for program, what in _listed().items()]
    try:
        print("\n".join([usage, *programs]), flush=True)
    except BrokenPipeError:  # `--help | head`: Python would write the rest when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
