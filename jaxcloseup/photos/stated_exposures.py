"""Exposures that the files of photographs state, as an explanation of gains that were solved."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


_BETTER = 0.5  # share of the error left out one by one that files must leave, to be believed


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
    """Return by how much log gains `[3]` of cameras exceed the log exposures of their files.

    A camera is left out unless gains of its left-out photographs follow better from their files,
    and its other photographs, than from the middle of all photographs: phones brighten what they
    show after the exposure.

    Args:
      log_gains: `[V, 3]`.
      stated: what each photograph's file says.
    """
    of_middle, offsets = _left_out(log_gains), {}
    for camera in {found.camera for found in stated if found}:
        rows = [view for view, found in enumerate(stated) if found and found.camera == camera]
        exposures = [found.log_exposure for found in stated if found and found.camera == camera]
        beyond = log_gains[rows] - np.array(exposures)[:, None]
        if len(rows) > 1:
            error, usual = (_left_out(beyond) ** 2).sum(), (of_middle[rows] ** 2).sum()
            if error <= _BETTER**2 * usual:
                offsets[camera] = beyond.mean(axis=0)
    return offsets


def _left_out(rows: np.ndarray) -> np.ndarray:
    """Return by how much each row `[N, 3]` differs from the mean of the others."""
    return (rows - rows.mean(axis=0)) * len(rows) / (len(rows) - 1)
