"""Choose some of a capture's training photographs."""

import numpy as np

from jaxcloseup.photos.scene import SceneError


_CLOSEST = 1e-3  # of a capture's size; nearer cameras count as being so far apart
_DIGITS = 6  # of sums of reciprocals, so that rounding does not choose between equal ones


def choose_photographs(
    name: str, poses: np.ndarray, count: int | None, choose: str = "path"
) -> list[int]:
    """Choose `count` of the training photographs, in their order.

    Args:
      name: name of the capture, for the error.
      poses: `[V, 3, 4]` poses of all training photographs.
      count: how many to keep; None keeps all.
      choose: one of `CHOICES`: `path` spreads them evenly over their order, `spread` over where
        cameras stand and look, so that angles between them are wide; `first` takes the first, as of
        a path that sees one side.

    Raises:
      SceneError: there are fewer.
    """
    total = len(poses)
    if count is None or count == total:
        return list(range(total))
    if count > total:
        raise SceneError(f"{name} has {total} training photographs: ask for fewer than {count}.")
    if choose == "spread":
        return _far_apart(_places(np.asarray(poses, np.float64)), count)
    if choose == "first":
        return list(range(count))
    return [(2 * i + 1) * total // (2 * count) for i in range(count)]


def _places(poses: np.ndarray) -> np.ndarray:
    """Return places `[V, 6]` that are far apart where cameras stand or look apart.

    The first half is where a camera stands around what all look at, in the unit ball, so that one
    far from all others does not count for more than its direction; the second where it looks.
    """
    positions, forward = poses[:, :, 3], poses[:, :, 2]
    away = positions - _looked_at(positions, forward)
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    typical = np.median(distance)
    stands = 2 * away / np.maximum(distance + typical, np.finfo(float).tiny)
    return np.concatenate([stands, forward], axis=1)


def _looked_at(positions: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the point `[3]` nearest to all optical axes, or as near to the cameras as can be."""
    middle = positions.mean(0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # projects along the axes
    offsets = np.einsum("vij,vj->i", across, positions - middle)
    return middle + np.linalg.lstsq(across.sum(0), offsets, rcond=1e-6)[0]


def _far_apart(places: np.ndarray, count: int) -> list[int]:
    """Choose places that repel each other least, as charges do that keep far apart.

    It begins at the place nearest to the middle of all, adds the farthest from those chosen, and
    then moves one at a time until none finds a better place.
    """

    def gaps(index: int) -> np.ndarray:
        return np.linalg.norm(places - places[index], axis=1)

    middle = np.linalg.norm(places - places.mean(0), axis=1)
    chosen = [int(middle.round(_DIGITS).argmin())]
    nearest = gaps(chosen[0])
    while len(chosen) < count:
        nearest[chosen[-1]] = -1
        chosen.append(int(nearest.round(_DIGITS).argmax()))
        nearest = np.minimum(nearest, gaps(chosen[-1]))

    def pushes(index: int) -> np.ndarray:
        return 1 / np.maximum(gaps(index), _CLOSEST) ** 2

    rows = np.array([pushes(index) for index in chosen])
    moved = True
    while moved:
        moved, total = False, rows.sum(0)
        for slot in range(count):
            push = (total - rows[slot]).round(_DIGITS)
            push[chosen[:slot] + chosen[slot + 1 :]] = np.inf
            best = int(push.argmin())
            if push[best] < push[chosen[slot]]:
                chosen[slot], moved = best, True
                total += pushes(best) - rows[slot]
                rows[slot] = pushes(best)
    return sorted(chosen)
