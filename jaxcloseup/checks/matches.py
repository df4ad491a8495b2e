"""Match photographs by their content alone, so that wrong poses cannot mislead the matching."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from jaxcloseup.captures.sift import Features, match_features, unit_descriptors


_STRONGEST = 160  # features of a photograph that look for similar photographs
_SIMILAR = 0.85  # cosine between descriptors that show the same, in this search
_NEIGHBORS = 3  # photographs that each one is matched with
_THRESHOLD = 1.5  # pixels of epipolar error of a match that counts as right
# Fewer right matches, or a smaller share of all, may come about by chance.
_FEWEST, _LEAST_SHARE = 16, 0.3
_MOST = 100  # matches of a pair that are kept, so that no pair outweighs others


class Matches(NamedTuple):
    """Features that pairs of photographs share; each pair's fit some epipolar geometry."""

    views: np.ndarray  # `[M, 2]` indices of the photographs
    pixels: np.ndarray  # `[M, 2, 2]` positions in pixels
    rgb: np.ndarray  # `[M, 2, 3]` uint8 colors

    def take(self, rows: slice | np.ndarray) -> "Matches":
        """Return some of the matches."""
        return Matches(self.views[rows], self.pixels[rows], self.rgb[rows])


def find_matches(found: Sequence[Features]) -> Matches:
    """Match similar photographs, and keep what fits one fundamental matrix for each pair.

    Args:
      found: features of each photograph.
    """
    views, pixels, colors = [], [], []
    for i, j in _similar_pairs(found):
        first, second = match_features(found[i].descriptors, found[j].descriptors)
        ends = found[i].pixels[first], found[j].pixels[second]
        right = np.flatnonzero(_fit_one_geometry(*ends))
        if len(right) < max(_FEWEST, _LEAST_SHARE * len(first)):
            continue
        right = right[np.linspace(0, len(right) - 1, min(_MOST, len(right))).astype(int)]
        views.append(np.tile([i, j], (len(right), 1)))
        pixels.append(np.stack([end[right] for end in ends], 1))
        pair = found[i].rgb[first[right]], found[j].rgb[second[right]]
        colors.append(np.stack(pair, 1))
    if not views:
        return Matches(np.zeros((0, 2), int), np.zeros((0, 2, 2)), np.zeros((0, 2, 3), np.uint8))
    return Matches(np.concatenate(views), np.concatenate(pixels), np.concatenate(colors))


def _similar_pairs(found: Sequence[Features]) -> Iterator[tuple[int, int]]:
    """Yield pairs of photographs, each photograph with those that share most strong features."""
    counts = np.zeros((len(found), len(found)), int)
    strong = [
        unit_descriptors(f.descriptors[np.argsort(-f.strengths, kind="stable")[:_STRONGEST]])
        for f in found
    ]
    for i, a in enumerate(strong):
        for j in range(i + 1, len(strong)):
            if len(a) and len(strong[j]):
                cosines = a @ strong[j].T
                best = cosines.argmax(1)
                mutual = cosines.argmax(0)[best] == np.arange(len(a))
                counts[i, j] = counts[j, i] = (mutual & (cosines.max(1) > _SIMILAR)).sum()
    pairs = set()
    for i, row in enumerate(counts):
        for j in np.argsort(-row, kind="stable")[:_NEIGHBORS].tolist():
            if row[j]:
                pairs.add((min(i, j), max(i, j)))
    yield from sorted(pairs)


def _fit_one_geometry(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return which matched pixels `[M, 2]` fit one fundamental matrix; `[M]` bool."""
    if len(first) < 8:
        return np.zeros(len(first), bool)
    # OpenCV's robust estimator draws its samples from a fixed seed.
    _, inside = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, _THRESHOLD, 0.999, 2000)
    return np.zeros(len(first), bool) if inside is None else inside[:, 0] > 0
