"""The splats of a stage for other programs."""

import pathlib

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.training.state import TrainState


def write_splats(folder: pathlib.Path, stage: str, programs: Programs, state: TrainState) -> None:
    """Write `<stage>.ply` in the capture's coordinates, of a field of splats."""
    if programs.method.splats is None:
        return
    surfels, alive = programs.method.splats(state.params, state.buffers)
    write_surfels(folder / f"{stage}.ply", surfels, alive, placement=programs.scene.placement)
