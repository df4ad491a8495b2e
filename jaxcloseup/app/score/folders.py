"""Score a folder of images against a folder of true images, whatever made them."""

import pathlib
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.score.scores import Perceptual, score_image, summarize
from jaxcloseup.captures.mask_values import read_mask, understand_masks
from jaxcloseup.captures.photo_files import ENDINGS, read_image
from jaxcloseup.photos.views import to_float


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
) -> dict[str, Any]:
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
    values = understand_masks(list(weights.values()))[0] if weights else None
    views = {}
    for name, path in progress.track(list(pairs.items()), "scoring images"):
        image, target = read_image(path), read_image(true[name])
        weight = np.ones(image.shape[:2], np.uint8) * 255
        if masks is not None:
            weight = read_mask(weights[name], values)
        for other, what in ((target, true[name]), (weight, weights.get(name))):
            if other.shape[:2] != image.shape[:2]:
                raise ValueError(
                    f"{path} has {_size(image)} pixels but {what} has {_size(other)}: render at "
                    "the size of the true image, because resizing changes the metrics"
                )
        views[name] = score_image(
            to_float(jnp.asarray(image)),
            to_float(jnp.asarray(target)),
            to_float(jnp.asarray(weight)),
            perceptual,
        )
    return summarize(views)


def _check_names(
    folder: str,
    names: Mapping[str, pathlib.Path],
    other: str,
    other_names: Mapping[str, pathlib.Path],
) -> None:
    missing = [name for name in other_names if name not in names]
    if missing:
        shown = _NAMES_IN_MESSAGE
        more = f" and {len(missing) - shown} more" if len(missing) > shown else ""
        raise ValueError(
            f"{folder} has no image named {', '.join(missing[:shown])}{more}, but {other} has: "
            "give both folders the same names"
        )


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
