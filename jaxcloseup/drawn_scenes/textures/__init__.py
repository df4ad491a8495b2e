"""Draw textures by name with NumPy and OpenCV."""

import zlib

import cv2
import numpy as np

from jaxcloseup.drawn_scenes.textures.details import DETAILS
from jaxcloseup.drawn_scenes.textures.materials import COLORS
from jaxcloseup.drawn_scenes.textures.patterns import SIZE
from jaxcloseup.drawn_scenes.textures.prints import PRINTS


def draw_texture(name: str) -> np.ndarray:
    """Draw the periodic texture `name`, `[1024, 1024, 3]` in [0, 1]; the name seeds the drawing.

    Materials and prints are colored; details are gray with mean 0.5, and multiply a color.
    """
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    if name in DETAILS:
        value = DETAILS[name](rng)
        return np.repeat(np.clip(0.5 + value - value.mean(), 0, 1)[..., None], 3, axis=-1)
    if name in COLORS:
        return np.clip(COLORS[name](rng), 0, 1)
    # A printed sheet has its own proportions, which the face that carries it restores.
    sheet = cv2.resize(PRINTS[name](rng), (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return sheet.astype(np.float32) / 255
