"""The splats of a stage for other programs."""

import pathlib

from jaxcloseup.app.run.programs import Programs
from jaxcloseup.artifacts.spz import pack_spz
from jaxcloseup.artifacts.surfel_ply import write_surfels
from jaxcloseup.io.files import write_file
from jaxcloseup.training.state import TrainState


def write_splats(folder: pathlib.Path, stage: str, programs: Programs, state: TrainState) -> None:
    """Write `<stage>.ply` and `<stage>.spz` in the capture's coordinates, of a field of splats."""
    if programs.method.splats is None:
        return
    surfels, alive = programs.method.splats(state.params, state.buffers)
    placement = programs.scene.placement
    write_surfels(folder / f"{stage}.ply", surfels, alive, placement=placement)
    write_file(folder / f"{stage}.spz", pack_spz(surfels, alive, placement=placement)[0])
