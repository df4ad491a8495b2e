"""Score anyone's renders: a folder of images against a folder of the true ones.

    python -m experiments.evaluate --renders=renders/rgb --truth=capture/test --output=metrics.json

Pairs are matched by name, whatever the ending. Metrics are those of experiments.run, on 8-bit
colors: means over images, and each image's own.
"""

import pathlib
import sys

import jax.numpy as jnp
import numpy as np
from absl import app, flags
from rich.console import Console
from rich.table import Table

from experiments.command_line import set_up
from experiments.evaluation.metrics_text import COLUMNS, format_metric
from experiments.evaluation.scores import Perceptual, find_perceptual, score_image, summarize
from jaxcloseup.captures.images import read_image, read_mask
from jaxcloseup.files import write_json
from jaxcloseup.photographs import to_float
from jaxcloseup.scenes import SceneError


FLAGS = flags.FLAGS
for _name in ("lpips_weights", "compilation_cache"):
    flags.declare_key_flag(_name)
flags.DEFINE_string("renders", None, "folder of images to score")
flags.DEFINE_string("truth", None, "folder of what they should be")
flags.DEFINE_string("masks", None, "folder of masks, white where pixels count; default: all count")
flags.DEFINE_string("output", "metrics.json", "file to write; never one that exists")

ENDINGS = {".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"}
SHOWN = 3


def images_by_name(flag: str, folder: str | None) -> dict[str, pathlib.Path]:
    """The images of a folder by their names without ending.

    Raises:
      ValueError: there is no such folder, no image in it, or two of one name.
    """
    if folder is None or not pathlib.Path(folder).is_dir():
        raise ValueError(f"--{flag}={folder or ''} is not a folder: name a folder of images")
    found: dict[str, pathlib.Path] = {}
    for path in sorted(pathlib.Path(folder).iterdir()):
        if path.suffix.lower() not in ENDINGS:
            continue
        if path.stem in found:
            raise ValueError(
                f"--{flag}={folder} has two images of one name, {found[path.stem].name} and "
                f"{path.name}: remove one"
            )
        found[path.stem] = path
    if not found:
        raise ValueError(f"--{flag}={folder} holds no image ({', '.join(sorted(ENDINGS))})")
    return found


def evaluate_folders(
    renders: str | None, truth: str | None, masks: str | None, perceptual: Perceptual
) -> dict:
    """Score every render against the true image of its name.

    Args:
      renders: folder of images to score.
      truth: folder of what they should be.
      masks: folder of masks, or None.
      perceptual: networks of LPIPS.

    Returns:
      Means over images and, by name, each image's metrics in `views`.

    Raises:
      ValueError: names or sizes do not match; one sentence that says which.
      SceneError: an image cannot be read.
    """
    pairs, true = images_by_name("renders", renders), images_by_name("truth", truth)
    weights = {} if masks is None else images_by_name("masks", masks)
    _match(f"--renders={renders}", pairs, f"--truth={truth}", true)
    _match(f"--truth={truth}", true, f"--renders={renders}", pairs)
    if masks is not None:
        _match(f"--masks={masks}", weights, f"--renders={renders}", pairs)
    views = {}
    for name, path in pairs.items():
        image, target = read_image(path), read_image(true[name])
        weight = np.ones(image.shape[:2], np.uint8) * 255
        if masks is not None:
            weight = read_mask(weights[name])
        for other, what in ((target, true[name]), (weight, weights.get(name))):
            if other.shape[:2] != image.shape[:2]:
                raise ValueError(
                    f"{path} has {_size(image)} pixels and {what} {_size(other)}: render at the "
                    "size of the truth, for resizing would change the metrics"
                )
        arrays = (to_float(jnp.asarray(array)) for array in (image, target, weight))
        views[name] = score_image(*arrays, perceptual)
    return summarize(views)


def _match(some, these, other, those):
    missing = [name for name in those if name not in these]
    if missing:
        more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        raise ValueError(
            f"{some} lacks {', '.join(missing[:SHOWN])}{more}, of which {other} has images: names "
            "must match one to one"
        )


def _size(image):
    return f"{image.shape[1]} x {image.shape[0]}"


def main(argv: list[str]) -> None:
    """Score the folders of the flags."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    output = pathlib.Path(FLAGS.output)
    try:
        if output.exists():
            raise ValueError(f"--output={output} already exists: name a new file, or remove it")
        perceptual = find_perceptual(FLAGS.lpips_weights)
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


if __name__ == "__main__":
    app.run(main)
