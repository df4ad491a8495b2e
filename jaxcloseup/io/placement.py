"""Where a scene lies in the coordinates of its capture's files."""

from typing import NamedTuple

import numpy as np


_ROUNDING = 3e-5  # in a scene, up to which float32 may round the coordinates in a file


class Placement(NamedTuple):
    """A shift and a uniform scale, without rotation, between two worlds, in float64.

    A scene's point is scale * (point of the capture's files - center). The files may have any unit
    of length and any origin: near that of a map, float32 tells only half meters apart.
    """

    center: np.ndarray = np.zeros(3)  # `[3]` in the capture's coordinates
    scale: float = 1.0  # length in the scene of the capture's unit

    def to_scene(self, points: np.ndarray) -> np.ndarray:
        """Map points `[..., 3]` of the capture to the scene."""
        return self.scale * (np.asarray(points, np.float64) - self.center)

    def to_capture(self, points: np.ndarray) -> np.ndarray:
        """Map points `[..., 3]` of the scene to the capture."""
        return np.asarray(points, np.float64) / self.scale + self.center

    def poses_to_scene(self, poses: np.ndarray) -> np.ndarray:
        """Map camera-to-world poses `[..., 3, 4]` of the capture to the scene."""
        return np.concatenate([poses[..., :3], self.to_scene(poses[..., 3])[..., None]], axis=-1)

    def poses_to_capture(self, poses: np.ndarray) -> np.ndarray:
        """Map camera-to-world poses `[..., 3, 4]` of the scene to the capture."""
        poses = np.asarray(poses, np.float64)
        return np.concatenate([poses[..., :3], self.to_capture(poses[..., 3])[..., None]], axis=-1)

    @property
    def offset(self) -> np.ndarray:
        """Shift `[3]` that files of float32 leave out: 0, unless the origin is far away.

        It has round numbers, for people. The files say so, and the shift, in their headers.
        """
        away = self.scale * np.abs(self.center).max()
        if away * np.finfo(np.float32).eps / 2 < _ROUNDING:
            return np.zeros(3)
        return np.round(self.center, int(np.ceil(np.log10(self.scale))))

    def to_file(self, points: np.ndarray) -> np.ndarray:
        """Map points `[..., 3]` of the scene to what files of float32 hold, in float64."""
        # The center and the offset are subtracted first: they may be large and alike.
        return np.asarray(points, np.float64) / self.scale + (self.center - self.offset)


UNMOVED = Placement()  # of scenes that have the coordinates of their files
