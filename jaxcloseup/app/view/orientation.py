"""Find the up direction of a scene's world."""

import numpy as np

from jaxcloseup.photos.scene import Scene


_TRUST = 1e-3  # weight of the cameras' mean up beside their horizontal axes
_SNAP = np.cos(np.radians(3))


def up_direction(scene: Scene) -> np.ndarray:
    """Return up `[3]`, of unit length: as the capture says, else from its training cameras.

    People seldom roll a camera, so its x-axis is level. Up is therefore the direction u that
    minimizes mean((x . u)^2) + e |u - m|^2 over the x-axes x of all cameras, with their mean up m.
    The small weight e makes m decide where all cameras look the same way. A direction within 3
    degrees of an axis of the world becomes that axis, because such a capture was aligned to it.

    Args:
      scene: its `metadata["up"]` is the up direction that the capture gives, or None.
    """
    if (given := scene.metadata.get("up")) is not None:
        return np.asarray(given, np.float64)
    rotations = np.asarray(scene.train.cameras.rotation, np.float64)
    across, mean = rotations[..., 0], -rotations[..., 1].mean(axis=0)
    spread = across.T @ across / len(across)
    up = np.linalg.solve(spread + _TRUST * np.eye(3), mean)
    up /= max(np.linalg.norm(up), 1e-12)
    axis = np.argmax(np.abs(up))
    return np.sign(up[axis]) * np.eye(3)[axis] if abs(up[axis]) > _SNAP else up
