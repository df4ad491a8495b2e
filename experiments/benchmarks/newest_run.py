"""The newest run of surfels on `table` in `outputs`, for suites that need a trained state."""

import pathlib
import sys
from typing import NamedTuple

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_run import choose_stage, load_run_scene, read_run, restore
from jaxcloseup.photos.scene import Scene
from jaxcloseup.training.state import TrainState


class NewestRun(NamedTuple):
    """A run as suites use it.

    Attributes:
      folder: where it is.
      stage: its last stage.
      scene: `table`.
      programs: what is compiled.
      state: of the stage.
    """

    folder: pathlib.Path
    stage: str
    scene: Scene
    programs: Programs
    state: TrainState


def newest_run() -> NewestRun:
    """Restore it, or exit with a sentence that says how to make one."""
    runs = sorted(pathlib.Path("outputs/table/surfels").glob("*/manifest.json"))
    if not runs:
        sys.exit(
            "experiments.bench: no run of table: run `python -m experiments.run --scene=table`"
        )
    record = read_run(runs[-1].parent)
    stage, scene = choose_stage(record, None), load_run_scene(record)
    return NewestRun(record.folder, stage, scene, *restore(record, scene, stage))
