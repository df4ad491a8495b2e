"""Exposures of a run's photographs, from the depth that stereo matched."""

import pathlib
from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.app import progress
from jaxcloseup.app.run.stereo_depths import StereoDepths, draw_points
from jaxcloseup.io.files import read_object, write_json
from jaxcloseup.photos.exposures import (
    Exposures,
    Metering,
    fit_metering,
    look_at_points,
    solve_gains,
)
from jaxcloseup.photos.views import camera_at, to_float


NAME = "exposures.json"
_POINTS = 5000  # at which photographs are compared
_AGREE = 0.02  # standard deviation of log gains up to which photographs have one exposure


def measure_exposures(stereo: StereoDepths) -> Exposures | None:
    """Return how exposures of photographs differ; None where they agree."""
    views = stereo.views
    points = jnp.asarray(draw_points(stereo, _POINTS)[0])
    depth = jnp.where(stereo.maps.confidence > 0, stereo.maps.depth, 0)
    look = jax.jit(look_at_points)

    def photograph(view: int) -> tuple[jax.Array, jax.Array]:
        return to_float(views.rgb[view]), views.weight[view]

    def seen(view: int) -> np.ndarray:
        camera = camera_at(views.cameras, view)
        return np.asarray(look(camera, depth[view], *photograph(view), points))

    with progress.saying("comparing exposures"):
        log_gains = solve_gains(np.stack(list(map(seen, range(len(views))))))
        spread = float(log_gains.std())
        if spread < _AGREE:
            return None
        unpadded = [_crop(*photograph(view)) for view in range(len(views))]
        metering = fit_metering(log_gains, unpadded)
    print(_describe(log_gains, metering.slopes))
    return Exposures(jnp.asarray(log_gains, jnp.float32), metering)


def _crop(rgb: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a photograph without the padding at its right and bottom, which has no middle."""
    used = np.asarray(weight) > 0
    height, width = (int(np.max(np.nonzero(used.any(axis))[0], initial=0)) + 1 for axis in (1, 0))
    return rgb[:height, :width], weight[:height, :width]


def write_exposures(
    folder: pathlib.Path, exposures: Exposures | None, names: Sequence[str]
) -> None:
    """Write `exposures.json`, from which renders take them; nothing where exposures agree."""
    if exposures is None:
        return
    plain = jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), exposures)
    gains = dict(zip(names, plain.log_gains, strict=True))
    write_json(folder / NAME, {"log_gains": gains, "metering": vars(plain.metering)})


def read_exposures(folder: pathlib.Path, names: Sequence[str]) -> Exposures | None:
    """Read the exposures of a run's photographs; None where the run has none.

    Raises:
      ValueError: the file is damaged, or of other photographs.
    """
    path = folder / NAME
    if not path.exists():
        return None
    try:
        kept = read_object(path)
        gains = jnp.asarray([kept["log_gains"][name] for name in names], jnp.float32)
        metering = Metering(**{k: jnp.asarray(v, jnp.float32) for k, v in kept["metering"].items()})
        chex.assert_shape((gains, metering.content, metering.slopes), ((len(names), 3), (3,), (2,)))
        chex.assert_shape(metering.width, ())
    except (KeyError, TypeError, ValueError, AttributeError, AssertionError):
        raise ValueError(
            f"{path} does not hold the exposures of these photographs: restore it from a copy of "
            "the run"
        ) from None
    return Exposures(gains, metering)


def _describe(log_gains: np.ndarray, slopes: jax.Array) -> str:
    """Say by how much exposures differ, and whether those of new views are predicted."""
    ratio = np.exp(np.ptp(log_gains.mean(axis=1)))
    predicted = "predicted" if np.any(np.asarray(slopes)) else "the middle one"
    return (
        f"photographs differ {ratio:.2g} times in exposure: they are brought to the "
        f"middle; the exposure of new views is {predicted}"
    )
