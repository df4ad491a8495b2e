"""Load the trained state of a stored run, for benchmarks and studies."""

import pathlib
import sys
from typing import NamedTuple

from jaxcloseup.app.run.kept_detail import detail_path, find_detail
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.store.stored_run import choose_stage, load_run_scene, read_run, restore
from jaxcloseup.detail.add import Detail
from jaxcloseup.photos.scene import Scene
from jaxcloseup.training.state import TrainState


class TrainedRun(NamedTuple):
    """A stored run with the state of one stage."""

    folder: pathlib.Path
    stage: str
    scene: Scene  # the scene that the run was trained on
    programs: Programs  # the run's compiled programs
    state: TrainState  # the newest state of the stage

    def detail(self) -> Detail:
        """Return the detail of the state, which the run's folder keeps."""
        kept = detail_path(self.folder, self.stage)
        return find_detail(self.programs, self.state, kept)[0]


def open_run(folder: pathlib.Path, stage: str | None = None) -> TrainedRun:
    """Load a run with the state of a stage, by default of its last one."""
    record = read_run(folder)
    chosen, scene = choose_stage(record, stage), load_run_scene(record)
    return TrainedRun(record.folder, chosen, scene, *restore(record, scene, chosen))


def newest_run() -> TrainedRun:
    """Load the newest run of surfels on `table` in `outputs`, or exit and say how to make one."""
    runs = sorted(pathlib.Path("outputs/table/surfels").glob("*/manifest.json"))
    if not runs:
        sys.exit(
            "experiments.bench: no run of table: run `python -m experiments.run --scene=table`"
        )
    return open_run(runs[-1].parent)
