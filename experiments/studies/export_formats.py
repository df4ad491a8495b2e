"""Sizes of exported splats beside plain PLY, and the PSNR that close-ups lose by each format.

    python -m experiments.studies.export_formats --runs=outputs/table,outputs/plush

Each run's splats are exported, read back by gsply (extra test), and rendered by the run's own
renderer at its held-out close-ups and their exposures, without detail.
"""

import pathlib
import tempfile

import gsply
import jax.numpy as jnp
import numpy as np
from absl import app, flags

from experiments.studies.trained_run import TrainedRun, open_run
from jaxcloseup.app.run.exposed import how_taken, render_exposed
from jaxcloseup.app.score.targets import score_divisor
from jaxcloseup.app.store.stored_run import read_run
from jaxcloseup.app.view.exporting import PACKED, export_splats
from jaxcloseup.artifacts.file_splats import FileSplats, with_y_up
from jaxcloseup.metrics.image_metrics import psnr
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import to_float
from jaxcloseup.training.state import TrainState


FLAGS = flags.FLAGS
_UNSEEN = -30.0  # logit of the opacity of rows that a file left out


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", None, "folders of finished runs of surfels", required=True)


def main(_: list[str]) -> None:
    """Print a line for each format of each run."""
    print("| splats | size | of plain PLY | PSNR lost | against the run's own render |")
    for folder in map(pathlib.Path, FLAGS.runs):
        with tempfile.TemporaryDirectory() as place:
            _compare(open_run(folder), pathlib.Path(place))


def _compare(run: TrainedRun, files: pathlib.Path) -> None:
    scene, names = run.scene, ["splats.ply", *PACKED]
    export_splats(files, read_run(run.folder), scene, run.stage, names)
    assert scene.photographs_at is not None
    photographs = scene.photographs_at(score_divisor(scene, None) or 1, "test")
    truth = [np.asarray(to_float(photograph.rgb)) for photograph in photographs]
    weights = [np.asarray(to_float(photograph.weight)) for photograph in photographs]
    taken = [how_taken(run.programs, "test", name) for name in scene.names["test"]]

    def show(state: TrainState) -> list[np.ndarray]:
        found = (
            render_exposed(run.programs, state, photograph.camera, how).rgb
            for photograph, how in zip(photographs, taken, strict=True)
        )
        return [np.clip(np.asarray(rgb), 0, 1) for rgb in found]

    own, plain = show(run.state), (files / "splats.ply").stat().st_size
    for name in names:
        size = (files / name).stat().st_size
        line = f"| {scene.name}, {name} | {size / 1e6:.1f} MB | {size / plain:.1%} |"
        if name.endswith(".glb"):  # it holds the same numbers as plain PLY
            print(line, "- | - |")
            continue
        shown = show(_with_splats(run.state, _read(files / name), scene))
        lost = _psnr(own, truth, weights) - _psnr(shown, truth, weights)
        print(line, f"{lost:+.3f} dB | {_psnr(shown, own, weights):.1f} dB |", flush=True)


def _read(path: pathlib.Path) -> FileSplats:
    spz = path.suffix == ".spz"
    found = (gsply.read_spz if spz else gsply.plyread)(path)
    coefficients = np.concatenate([found.sh0[:, None], found.shN], axis=1)
    splats = FileSplats(found.means, found.scales, found.quats, found.opacities, coefficients)
    return with_y_up(splats) if spz else splats


def _with_splats(state: TrainState, splats: FileSplats, scene: Scene) -> TrainState:
    """Return a state whose first rows are splats of a file; the others show nothing."""
    values = {
        "means": scene.placement.to_scene(splats.means + scene.placement.offset),
        "log_scales": splats.log_scales[:, :2] + np.log(scene.placement.scale),
        "quaternions": splats.quaternions,
        "opacity_logits": splats.opacities,  # as gsply returns them
        "sh": splats.sh,
    }
    count = len(splats.means)
    old = state.params.replace(opacity_logits=jnp.full_like(state.params.opacity_logits, _UNSEEN))
    read = {name: getattr(old, name).at[:count].set(value) for name, value in values.items()}
    return state.replace(params=old.replace(**read))


def _psnr(images: list[np.ndarray], truth: list[np.ndarray], weights: list[np.ndarray]) -> float:
    views = zip(images, truth, weights, strict=True)
    return float(np.mean([psnr(image, true, weight=weight) for image, true, weight in views]))


if __name__ == "__main__":
    define_flags()
    app.run(main)
