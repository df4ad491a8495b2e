"""A sweep of every method on every scene, and one table of them: `experiments.sweep --methods`.

Each is a sweep of its own, in a process of its own: what one needs is measured apart from the
others, and one that fails costs no other.
"""

import contextlib
import os
import pathlib
import shutil
import sys
from collections.abc import Mapping, Sequence
from subprocess import call
from typing import Any

from absl import flags

from jaxcloseup.app.cli import chosen as training_flags
from jaxcloseup.app.cli.start import CHECKPOINTS, LOCK, lock_output_dir, prepare_to_stop
from jaxcloseup.app.jobs.sweep import check_flags
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.report.method_tables import read_method, write_methods
from jaxcloseup.app.run.manifest import NAME as MANIFEST
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
_OWN = ("methods", "method", "scenes", "output_dir", "resume")  # differ from process to process


def main() -> None:
    """Sweep the methods of the flags; those that an interrupted sweep has finished stay."""
    methods = FLAGS.methods
    try:
        unknown = [name for name in methods if name not in METHODS]
        if unknown or len(set(methods)) < len(methods):
            raise ValueError(
                f"--methods={','.join(methods)} must name some of {', '.join(METHODS)}, each once"
            )
        for method in methods:
            FLAGS.method = method
            check_flags(training_flags.preset_from_flags())
        if FLAGS.coordinator is not None:
            raise ValueError("--methods sweeps on one host: leave out --coordinator")
        folder = _choose_folder()
        prepare_to_stop(folder, "experiments.sweep")
        lock = lock_output_dir(folder)
    except (OSError, ValueError) as error:
        sys.exit(f"experiments.sweep: {error}")
    scenes = {os.path.basename(os.path.realpath(scene)): scene for scene in FLAGS.scenes}
    with lock:
        failed = sweep_methods(folder, methods, scenes)
    if failed:
        sys.exit(f"experiments.sweep: left out, for the reasons above: {', '.join(failed)}")
    print(f"tables: {folder / 'methods.md'}")


def _choose_folder():
    """The output folder, whose subfolders hold what is to be resumed."""
    if FLAGS.resume:
        if FLAGS.output_dir is None or not (pathlib.Path(FLAGS.output_dir) / LOCK).exists():
            raise FileNotFoundError(
                f"--resume finds no sweep in --output_dir={FLAGS.output_dir or ''}: name the "
                "folder of one that was cut off"
            )
        return pathlib.Path(FLAGS.output_dir)
    return training_flags.choose_output_dir(FLAGS.output_dir, "sweep", "methods")


def sweep_methods(
    folder: pathlib.Path, methods: Sequence[str], scenes: Mapping[str, str]
) -> list[str]:
    """Sweep method by method, scene by scene, and write the tables after each.

    Args:
      folder: for `<method>/<scene>`, each a sweep's folder, and for the tables.
      methods: names of the methods.
      scenes: what `--scenes` takes, by name.

    Returns:
      What failed, as method and scene.
    """
    found: dict[str, dict[str, Any]] = {}
    failed = []
    for method in methods:
        for name, scene in scenes.items():
            own = folder / method / name
            print(f"{method} on {name}")
            if not _prepare(own) and call(_command(own, method, scene)):
                failed.append(f"{method} on {name}")
                continue
            found.setdefault(method, {})[name] = read_method(own)
            write_methods(folder, found)
    return failed


def _prepare(folder):
    """Whether a sweep is finished; what one left that cannot be resumed is removed."""
    with contextlib.suppress(OSError, ValueError):
        if read_object(folder / MANIFEST).get("finished") is True:
            return True
    if not (folder / CHECKPOINTS).is_dir():
        shutil.rmtree(folder, ignore_errors=True)
    return False


def _command(folder, method, scene):
    """The command that sweeps one method on one scene with the other flags of this program."""
    given = [flag for flag in FLAGS.get_key_flags_for_module(sys.argv[0]) if flag.present]
    flagged = "\n".join(flag.serialize() for flag in given if flag.name not in _OWN)
    words = flagged.split("\n") if flagged else []
    own = {"method": method, "scenes": scene, "output_dir": folder}
    words += [f"--{name}={value}" for name, value in own.items()]
    if (folder / CHECKPOINTS).is_dir():
        words.append("--resume")
    return [sys.executable, "-m", "experiments.sweep", *words]
