"""Scores of a folder of images: what `experiments.evaluate` does."""

import pathlib
import sys

import jax.numpy as jnp
import numpy as np
from absl import flags
from rich.console import Console
from rich.table import Table

from jaxcloseup.app import progress
from jaxcloseup.app.cli.start import set_up
from jaxcloseup.app.score.metrics_text import COLUMNS, format_metric
from jaxcloseup.app.score.scores import Perceptual, find_perceptual, score_image, summarize
from jaxcloseup.captures.load import SceneError
from jaxcloseup.captures.photo_files import ENDINGS, read_image, read_mask
from jaxcloseup.io.files import write_json
from jaxcloseup.photos.views import to_float


FLAGS = flags.FLAGS
_NAMES_IN_MESSAGE = 3


def images_by_name(flag: str, folder: str | None) -> dict[str, pathlib.Path]:
    """Return the paths of a folder's images by file name without ending.

    Args:
      flag: name of the flag that gave the folder, for error messages.
      folder: the folder, or None where the flag is missing.

    Raises:
      ValueError: the folder does not exist, holds no image, or holds two images of one name.
    """
    if folder is None or not pathlib.Path(folder).is_dir():
        raise ValueError(f"--{flag}={folder or ''} is not a folder: name a folder of images")
    found: dict[str, pathlib.Path] = {}
    for path in sorted(pathlib.Path(folder).iterdir()):
        if path.suffix.lower() not in ENDINGS:
            continue
        if path.stem in found:
            raise ValueError(
                f"--{flag}={folder} has two images with the same name, {found[path.stem].name} and "
                f"{path.name}: remove one"
            )
        found[path.stem] = path
    if not found:
        raise ValueError(f"--{flag}={folder} holds no image ({', '.join(sorted(ENDINGS))})")
    return found


def evaluate_folders(
    renders: str | None, truth: str | None, masks: str | None, perceptual: Perceptual
) -> dict:
    """Score every render against the true image with its name.

    Args:
      renders: folder of rendered images to score.
      truth: folder of true images.
      masks: folder of masks, or None where all pixels count.
      perceptual: LPIPS networks.

    Returns:
      The mean of each metric over images, and in `views` the metrics of each image by name.

    Raises:
      ValueError: names or sizes do not match; the message is one sentence that names them.
      SceneError: an image cannot be read.
    """
    pairs, true = images_by_name("renders", renders), images_by_name("truth", truth)
    weights = {} if masks is None else images_by_name("masks", masks)
    _check_names(f"--renders={renders}", pairs, f"--truth={truth}", true)
    _check_names(f"--truth={truth}", true, f"--renders={renders}", pairs)
    if masks is not None:
        _check_names(f"--masks={masks}", weights, f"--renders={renders}", pairs)
    views = {}
    for name, path in progress.track(list(pairs.items()), "scoring images"):
        image, target = read_image(path), read_image(true[name])
        weight = np.ones(image.shape[:2], np.uint8) * 255
        if masks is not None:
            weight = read_mask(weights[name])
        for other, what in ((target, true[name]), (weight, weights.get(name))):
            if other.shape[:2] != image.shape[:2]:
                raise ValueError(
                    f"{path} has {_size(image)} pixels but {what} has {_size(other)}: render at "
                    "the size of the true image, because resizing changes the metrics"
                )
        arrays = (to_float(jnp.asarray(array)) for array in (image, target, weight))
        views[name] = score_image(*arrays, perceptual)
    return summarize(views)


def _check_names(folder, names, other, other_names):
    missing = [name for name in other_names if name not in names]
    if missing:
        shown = _NAMES_IN_MESSAGE
        more = f" and {len(missing) - shown} more" if len(missing) > shown else ""
        raise ValueError(
            f"{folder} has no image named {', '.join(missing[:shown])}{more}, but {other} has: "
            "give both folders the same names"
        )


def _size(image):
    return f"{image.shape[1]} x {image.shape[0]}"


def main() -> None:
    """Score the folders that the flags name."""
    set_up()
    output = pathlib.Path(FLAGS.output)
    try:
        if output.exists():
            raise ValueError(f"--output={output} already exists: name a new file, or remove it")
        perceptual = find_perceptual(FLAGS.lpips_weights)
        with progress.showing():
            results = evaluate_folders(FLAGS.renders, FLAGS.truth, FLAGS.masks, perceptual)
        write_json(output, results)
    except (SceneError, OSError, ValueError) as error:
        sys.exit(f"experiments.evaluate: {error}")
    table = Table(f"{len(results['views'])} images", "mean")
    for key, name in COLUMNS.items():
        if key in results:
            table.add_row(name, format_metric(key, results[key]))
    Console().print(table)
    for key in ("lpips_vgg", "lpips_alex"):
        if results[key] is None:
            print(f"no {key}: {results[f'{key}_reason']}")
    print(f"metrics: {output}")
