"""A sweep of every method on every scene, and one table of them.

Each is a sweep of its own, in a process of its own: its time and memory are measured apart from the
others, and one that fails costs no other.
"""

import contextlib
import pathlib
import shutil
from collections.abc import Mapping, Sequence
from subprocess import call
from typing import Any

from jaxcloseup.app.report.method_tables import read_method, write_methods
from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.io.files import read_object


def sweep_methods(
    folder: pathlib.Path, methods: Sequence[str], scenes: Mapping[str, str], command: Sequence[str]
) -> list[str]:
    """Sweep method by method, scene by scene, and write the tables after each.

    `folder` gets the tables and a sweep's folder `<method>/<scene>` each. `scenes` has values of
    `--scenes` by name. `command` starts a sweep, with the flags that all of them share.

    Returns:
      What failed, as method and scene.
    """
    found: dict[str, dict[str, Any]] = {}
    failed = []
    for method in methods:
        for name, scene in scenes.items():
            output_dir = folder / method / name
            print(f"{method} on {name}")
            flags = {"method": method, "scenes": scene, "output_dir": output_dir}
            words = [*command, *(f"--{flag}={value}" for flag, value in flags.items())]
            if not _is_finished(output_dir) and call([*words, *_resuming(output_dir)]):
                failed.append(f"{method} on {name}")
                continue
            found.setdefault(method, {})[name] = read_method(output_dir)
            write_methods(folder, found)
    return failed


def _is_finished(folder: pathlib.Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return read_object(folder / MANIFEST).get("finished") is True
    return False


def _resuming(folder: pathlib.Path) -> list[str]:
    """Return the flag that resumes a sweep; a folder that cannot be resumed is removed."""
    if (folder / "checkpoints").is_dir():
        return ["--resume"]
    shutil.rmtree(folder, ignore_errors=True)
    return []
