"""Close-ups in a folder: two pictures each, and a record of where they are."""

import pathlib
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app.share.closeups import CloseUp
from jaxcloseup.artifacts.images import write_png
from jaxcloseup.geometry.cameras import Camera
from jaxcloseup.io.files import read_object, write_json


def keep_closeup(folder: pathlib.Path, closeup: CloseUp) -> None:
    """Write `<name>.png`, `<name>_error.png` and `<name>.json`, which comes last.

    Raises:
      OSError: one sentence that names the path and the reason.
    """
    write_png(folder / f"{closeup.name}.png", closeup.picture)
    write_png(folder / f"{closeup.name}_error.png", closeup.error)
    camera = closeup.camera
    record = {
        "said": closeup.said,
        "said_of_error": closeup.said_of_error,
        "point": closeup.point.tolist(),
        "camtoworld": np.asarray(camera.camtoworld).tolist(),
        "intrinsics": np.asarray(camera.intrinsics).tolist(),
    }
    write_json(folder / f"{closeup.name}.json", record)


def kept_closeups(folder: pathlib.Path) -> list[CloseUp]:
    """Return the close-ups that a folder keeps, oldest first.

    Raises:
      ValueError: one sentence that names a file that is damaged.
    """
    records = sorted(folder.glob("*.json"), key=lambda path: (path.stat().st_mtime_ns, path.name))
    return [_read(path) for path in records]


def _read(path: pathlib.Path) -> CloseUp:
    try:
        record = read_object(path)
        picture, errors = (
            _image(path.with_name(path.stem + end)) for end in (".png", "_error.png")
        )
        height, width = picture.shape[:2]
        pose, intrinsics, point = (
            np.array(record[name], np.float32).reshape(shape)
            for name, shape in (("camtoworld", (3, 4)), ("intrinsics", 4), ("point", 3))
        )
        said: list[Any] = [str(record[name]) for name in ("said", "said_of_error")]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged ({error}): remove it, and make it again") from error
    camera = Camera(jnp.asarray(pose), jnp.asarray(intrinsics), height, width)
    return CloseUp(path.stem, camera, point, picture, errors, *said)


def _image(path: pathlib.Path) -> np.ndarray:
    image = cv2.imread(str(path))
    if image is None:
        raise ValueError(f"{path.name} is missing or no image")
    return image[..., ::-1]
