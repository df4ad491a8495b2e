"""Choose which photographs to match with each other.

The number of all pairs grows with the square of the number of photographs. Frames of a video
overlap with their neighbors; photographs with similar features are likely to overlap.
"""

from collections.abc import Sequence

import numpy as np

from jaxcloseup.app.process.options import LONGEST_SIDE, MOST_EXHAUSTIVE


_NEIGHBORS = 10  # on each side in a video
_TOGETHER = 8  # photographs on each side of the pairs that are matched one after the other
_SIMILAR = {"sequential": 5, "retrieval": 30}  # photographs for each
_WORDS, _SAMPLES, _ROUNDS = 64, 50_000, 10  # of the vocabulary: words, descriptors, iterations


def choose_pairing(pairing: str, count: int, *, video: bool) -> str:
    """Resolve `auto`: sequential for a video, else by the number of photographs."""
    if pairing != "auto":
        return pairing
    if video:
        return "sequential"
    return "exhaustive" if count <= MOST_EXHAUSTIVE else "retrieval"


def expected_seconds(sizes: Sequence[tuple[int, int]], pairing: str, cores: int) -> float:
    """Return about how long features, matches and poses take together.

    Measured on two cores: 97 photographs of 800 x 600, 86 s; 45 of 4032 x 3024, 374 s.

    Args:
      sizes: width and height of each photograph in pixels.
      pairing: one of `choices.PAIRINGS`.
      cores: of the computer.
    """
    shrink = (min(1.0, LONGEST_SIDE / max(size)) for size in sizes)
    pixels = [part**2 * size[0] * size[1] for part, size in zip(shrink, sizes, strict=True)]
    partners = len(sizes) - 1
    if pairing != "exhaustive":
        partners = min(partners, 2 * _SIMILAR["retrieval"])
    alone = 0.1 * len(sizes) + 0.63e-6 * sum(pixels)
    together = 2.04e-8 * sum(pixels) * partners / 2
    return 2 / cores * (alone + together)


def pairs_to_match(pairing: str, descriptors: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """List the pairs (i, j), i < j, of photographs to match, in order.

    `exhaustive` takes all. `sequential` takes the next 10, the ones 16, 32, 64, ... later, and the
    5 most similar ones, which close loops. `retrieval` takes the 30 most similar ones and both
    neighbors, since photographs are often numbered in the order in which they were taken.

    Args:
      pairing: one of `choices.PAIRINGS`.
      descriptors: for each photograph, `[F, 128]` SIFT descriptors; F may be 0.
    """
    count = len(descriptors)
    if pairing == "exhaustive" or count - 1 <= _SIMILAR[pairing]:
        pairs = ((i, j) for i in range(count) for j in range(i + 1, count))
        # Some at a time need features of few photographs, which take time to prepare.
        return sorted(pairs, key=lambda pair: (pair[0] // _TOGETHER, pair[1] // _TOGETHER, pair))
    near = [1]
    if pairing == "sequential":
        near = [*range(1, _NEIGHBORS + 1), *(2**k for k in range(4, count.bit_length()))]
    chosen = {(i, i + step) for step in near for i in range(count - step)}
    likeness = similarity(descriptors)
    np.fill_diagonal(likeness, -np.inf)
    best = np.argsort(-likeness, axis=1, kind="stable")[:, : _SIMILAR[pairing]]
    chosen |= {(min(i, j), max(i, j)) for i in range(count) for j in best[i].tolist()}
    return sorted(chosen)


def similarity(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the cosine similarity `[V, V]` of photographs by their VLAD descriptors.

    Each photograph is the sum, for each word of a vocabulary, of how its descriptors differ from
    the word (Jegou et al. 2010, with the signed square roots and the norms for each word of
    Arandjelovic and Zisserman 2013). The vocabulary is learned from the photographs themselves.
    """
    roots = [_roots(each) for each in descriptors]
    words = _vocabulary(np.concatenate(roots))
    vlad = np.zeros((len(roots), *words.shape), np.float32)
    for total, units in zip(vlad, roots, strict=True):
        chosen = _nearest(units, words)
        total[:] = chosen.T @ units - chosen.sum(0)[:, None] * words
    vlad = np.sign(vlad) * np.sqrt(np.abs(vlad))
    vlad /= np.maximum(np.linalg.norm(vlad, axis=-1, keepdims=True), 1e-6)
    flat = vlad.reshape(len(vlad), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-6)
    return flat @ flat.T


def _roots(descriptors: np.ndarray) -> np.ndarray:
    """Return unit vectors, whose products compare descriptors as COLMAP's matcher does."""
    values = np.asarray(descriptors, np.float32).reshape(-1, 128)
    return values / np.maximum(np.linalg.norm(values, axis=-1, keepdims=True), 1e-6)


def _vocabulary(descriptors: np.ndarray) -> np.ndarray:
    """Cluster unit descriptors `[F, 128]` by k-means; returns `[K, 128]`, K at most 64."""
    rng = np.random.default_rng(0)
    if len(descriptors) > _SAMPLES:
        descriptors = descriptors[rng.choice(len(descriptors), _SAMPLES, replace=False)]
    words = descriptors[rng.permutation(len(descriptors))[:_WORDS]]
    if not len(words):
        return np.zeros((1, 128), np.float32)
    for _ in range(_ROUNDS):
        chosen = _nearest(descriptors, words)
        counts = chosen.sum(0)[:, None]
        words = np.where(counts > 0, chosen.T @ descriptors / np.maximum(counts, 1), words)
    return words


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the nearest word of each descriptor as one-hot float32 `[F, K]`."""
    nearest = np.argmin(np.sum(words**2, -1) - 2 * descriptors @ words.T, axis=-1)
    return np.eye(len(words), dtype=np.float32)[nearest]
