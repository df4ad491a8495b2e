"""Exposures that the files of photographs state, as an explanation of gains that were solved."""

import collections
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


_BETTER = 0.7  # share of the error left out one by one that files must leave, to be believed


class StatedExposure(NamedTuple):
    """What the file of a photograph says of its exposure."""

    camera: str  # maker and model
    log_exposure: float  # log of seconds x ISO / f-number squared


def stated_differences(stated: Sequence[StatedExposure | None]) -> np.ndarray:
    """Return how log exposures `[V, 1]` differ from their camera's mean; 0 where a file says none.

    Cameras differ in what they make of the same exposure.
    """
    means = {
        camera: np.mean(
            [found.log_exposure for found in stated if found and found.camera == camera]
        )
        for camera in {found.camera for found in stated if found}
    }
    known = [found.log_exposure - means[found.camera] if found else 0.0 for found in stated]
    return np.array(known)[:, None]


def fit_cameras(
    log_gains: np.ndarray, stated: Sequence[StatedExposure | None]
) -> dict[str, np.ndarray]:
    """Return by how much log gains `[3]` of each camera exceed the log exposures of its files.

    Returns nothing unless the gains of left-out photographs follow better from their files, and the
    other photographs of their camera, than from the middle of all photographs.

    Args:
      log_gains: `[V, 3]`.
      stated: what each photograph's file says.
    """
    pairs = [(gain, found) for gain, found in zip(log_gains, stated, strict=True) if found]
    counts = collections.Counter(found.camera for _, found in pairs)
    pairs = [(gain, found) for gain, found in pairs if counts[found.camera] > 1]
    if not pairs:
        return {}
    beyond = {
        camera: np.array([g - found.log_exposure for g, found in pairs if found.camera == camera])
        for camera in {found.camera for _, found in pairs}
    }
    of_files = np.concatenate([_left_out(rows) for rows in beyond.values()])
    of_middle = _left_out(np.array([gain for gain, _ in pairs]))
    if (of_files**2).sum() > _BETTER**2 * (of_middle**2).sum():
        return {}
    return {camera: rows.mean(axis=0) for camera, rows in beyond.items()}


def _left_out(rows: np.ndarray) -> np.ndarray:
    """Return by how much each row `[N, 3]` differs from the mean of the others."""
    return (rows - rows.mean(axis=0)) * len(rows) / (len(rows) - 1)
