"""Exposures that the files of photographs state, as an explanation of gains that were solved."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


_BETTER = 0.5  # share of the error left out one by one that files must leave, to be believed


class StatedExposure(NamedTuple):
    """What the file of a photograph says of its exposure."""

    camera: str  # maker and model
    log_exposure: float  # log of seconds x ISO / f-number squared


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
    offsets: dict[str, np.ndarray] = {}
    if len(log_gains) < 2:
        return offsets
    of_middle = _left_out(log_gains)
    for camera in {found.camera for found in stated if found}:
        rows = [view for view, found in enumerate(stated) if found and found.camera == camera]
        exposures = [found.log_exposure for found in stated if found and found.camera == camera]
        beyond = log_gains[rows] - np.array(exposures)[:, None]
        if len(rows) > 1:
            error, usual = (_left_out(beyond) ** 2).sum(), (of_middle[rows] ** 2).sum()
            if error <= _BETTER**2 * usual:
                offsets[camera] = beyond.mean(axis=0)
    return offsets


def gains_of_files(
    stated: Sequence[StatedExposure | None], offsets: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the log gains `[V, 3]` that follow from files; 0 where no camera is in `offsets`."""
    found = [
        one.log_exposure + offsets[one.camera] if one and one.camera in offsets else np.zeros(3)
        for one in stated
    ]
    return np.stack(found)


def _left_out(rows: np.ndarray) -> np.ndarray:
    """Return by how much each row `[N, 3]` differs from the mean of the others."""
    return (rows - rows.mean(axis=0)) * len(rows) / (len(rows) - 1)
