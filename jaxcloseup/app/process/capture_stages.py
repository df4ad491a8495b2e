"""Keep the sources and the finished stages of a capture in `process.json`."""

import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any

from jaxcloseup.app.process.solver_process import ProcessingError
from jaxcloseup.io.files import read_object, write_json


NAME = "process.json"


class Stages:
    """Finished stages of a capture; each is kept as soon as it ends.

    Args:
      folder: folder of the capture.
      made_from: flags, files and versions, which determine the capture.

    Raises:
      ProcessingError: the folder holds a capture that was made from something else.
    """

    def __init__(self, folder: pathlib.Path, made_from: Mapping[str, Any]) -> None:
        """Read the file in the folder, if there is one; write nothing."""
        self._file = folder / NAME
        self._held: dict[str, Any] = {"made_from": dict(made_from), "stages": {}}
        if not self._file.exists():
            return
        try:
            held = read_object(self._file)
            stages = {name: dict(stage) for name, stage in held["stages"].items()}
            before = dict(held["made_from"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ProcessingError(
                f"{self._file} cannot be read ({error}): name a new folder, or remove it"
            ) from error
        other = [name for name, value in made_from.items() if before.get(name) != value]
        if not stages:  # its first stage did not end
            return
        if other:
            name = other[0]
            what = f"{name} was {before.get(name)!s:.80} and is {made_from[name]!s:.80}"
            what = "the files changed" if name == "files" else what
            raise ProcessingError(
                f"--output_dir={folder} holds a capture made from something else ({what}): name a "
                "new folder, or remove it"
            )
        self._held["stages"] = stages

    def run(self, name: str, proof: str, make: Callable[[], Any]) -> Any:
        """Return the result of a stage; make it unless it was finished before.

        Args:
          name: name of the stage.
          proof: file or folder that the stage leaves in the capture; without it, it runs again.
          make: runs the stage; returns values for JSON.
        """
        stages = self._held["stages"]
        if name not in stages or not (self._file.parent / proof).exists():
            began = time.monotonic()
            # Later stages depend on this one.
            for later in list(stages)[list(stages).index(name) :] if name in stages else ():
                del stages[later]
            write_json(self._file, self._held)
            result = make()
            stages[name] = {"result": result, "seconds": round(time.monotonic() - began, 1)}
            write_json(self._file, self._held)
        return stages[name]["result"]

    def keep(self, name: str, value: Any) -> None:
        """Write a further field."""
        self._held[name] = value
        write_json(self._file, self._held)
