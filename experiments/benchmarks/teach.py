"""Learn how far to trust the detail of photographs, from the true close-ups of runs.

The suite reads the stage `baseline` of every run in `outputs/teach/KIND`, of two scenes or more
(`experiments.studies.detail_teachers` makes them), and writes `outputs/teach/detail_weights.npz`,
as the package's `jaxcloseup/detail/weights.npz` was made. It compares the detail of photographs in
each held-out view with the truth. Small networks, each without one scene, learn how much detail to
add and the error that remains. Each is tested on its scene: the suite prints the PSNR of held-out
views before and after, and the ratio of actual to expected error for every tenth of the pixels.
"""

import pathlib
import sys
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments.studies.trained_run import open_run
from jaxcloseup.app.score.expected_errors import error_tenths
from jaxcloseup.detail.add import find_candidates
from jaxcloseup.detail.learn import PIXELS, Evidence, learn_weights, make_evidence, sample_evidence
from jaxcloseup.detail.weights import (
    DetailWeights,
    blend,
    expected_errors,
    one_network,
    write_known,
)
from jaxcloseup.geometry.cameras import pixel_grid
from jaxcloseup.labels.rules import label_depth
from jaxcloseup.photos.scene import Scene
from jaxcloseup.photos.views import Photograph, to_float, unpadded


FOLDER, STAGE = pathlib.Path("outputs/teach"), "baseline"


def run(folder: pathlib.Path = FOLDER) -> None:
    """Learn from the runs in a folder, write the weights, and print their scores."""
    scenes: dict[str, list[Evidence]] = {}
    for path in sorted(folder.glob("*/*/manifest.json")):
        name, found = run_evidence(path.parent)
        scenes.setdefault(name, []).extend(found)
    if len(scenes) < 2:
        sys.exit(f"experiments.bench: {folder} must hold runs of two scenes or more")
    try:
        weights = learn_weights(scenes)
    except ValueError as error:
        sys.exit(f"experiments.bench: {folder}: {error}")
    write_known(folder / "detail_weights.npz", list(scenes), weights)
    for index, (name, views) in enumerate(scenes.items()):
        found = _describe(one_network(weights, index), views)
        print(f"{name:>8}, which its network never saw: {found}", flush=True)


def run_evidence(folder: pathlib.Path) -> tuple[str, list[Evidence]]:
    """Return the name of a run's scene, and the evidence from each of its held-out views."""
    trained = open_run(folder, STAGE)
    scene, programs, state = trained.scene, trained.programs, trained.state
    detail = trained.detail()

    def evidence(photograph, count, index):
        camera = photograph.camera
        seen = programs.render(state, camera)
        depth = label_depth(seen, near=0, far=scene.far)
        pixels = pixel_grid(camera.height, camera.width)
        found = find_candidates(detail, camera, pixels, seen.rgb, seen.alpha, depth)
        own = to_float(jnp.asarray(photograph.rgb)) - jnp.clip(seen.rgb, 0, 1)
        told = make_evidence(found, own, to_float(jnp.asarray(photograph.weight)))
        return sample_evidence(told, PIXELS // count, seed=index)

    finer = _FINER if programs.method.splats else _FINER[:1]  # rays of whole images take minutes
    kinds = _held_out(scene, finer)
    return scene.name, [
        evidence(photograph, len(views), i) for views in kinds for i, photograph in enumerate(views)
    ]


_FINER = 4, 1  # divisors of the photographs' size of the finer views among those that teach


def _held_out(scene: Scene, finer: Sequence[int]) -> Iterator[Sequence[Photograph]]:
    for split in ("test", "test_far"):
        if getattr(scene, split) is not None:
            yield unpadded(getattr(scene, split), scene.sizes(split))
            if scene.photographs_at:
                yield from (scene.photographs_at(divisor, split) for divisor in finer)


def _describe(weights: DetailWeights, views: Sequence[Evidence]) -> str:
    """Describe PSNR of all pixels before and after, and actual over expected errors."""
    found = jax.tree.map(lambda *rows: np.concatenate(rows), *views)
    mixed, share = blend(weights, *map(jnp.asarray, found[:3]))
    errors = [
        np.abs(off) for off in (found.missing, found.missing - np.asarray(share[:, None] * mixed))
    ]
    before, after = (-10 * np.log10(np.mean(error**2)) for error in errors)
    expected = np.asarray(expected_errors(weights, jnp.asarray(found.features)))[:, 1]
    tenths = error_tenths(expected, errors[1].mean(-1), found.weight)
    ratios = ", ".join(f"{row['actual'] / row['expected']:.2f}" for row in tenths)
    return f"{before:.2f} to {after:.2f} dB; actual / expected error {ratios}"
