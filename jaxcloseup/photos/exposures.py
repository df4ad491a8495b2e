"""Exposures: how much brighter each photograph is than the others, and how its camera chose that.

A gain is the factor of a photograph's light over the same light at the middle exposure, at which
logarithms of gains are 0 on average. Light is what colors of sRGB encode.
"""

import collections
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcloseup.geometry.cameras import Camera, points_to_pixels
from jaxcloseup.geometry.masks import depth_consistent, in_bounds
from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.geometry.warp import backward_warp, reads_unmixed
from jaxcloseup.photos.light import (
    change_exposure,
    colors_by_curve,
    light_by_curve,
    to_colors,
    to_light,
)
from jaxcloseup.photos.views import Views, to_float


USABLE = 0.03, 0.97  # colors beyond are noise, or clipped
_LEAST = 0.05  # residual of log light below which all count alike
_ROUNDS = 10  # of reweighting
_HELD = 1.0  # weight of what is expected in each gain, in points
_WIDTHS = 0.2, 0.35, 0.5, 10.0  # candidates for `Metering.width`
_BLACK = 3e-4  # light of colors of 1 / 255, below which a photograph shows nothing
_BETTER = 0.7  # share of the error left out one by one that a slope must leave, to be believed


class Metering(struct.PyTreeNode):
    """How a camera chose its exposures from what it saw.

    Attributes:
      width: `[]` standard deviation of the weights of an image's pixels around its middle, in
        widths and heights of the image.
      content: `[3]` mean over photographs of `meter` at the middle exposure.
      slopes: `[2]` change of a photograph's log gain with what was metered: of all colors, and of
        each color against all; -1 for a camera that makes all photographs equally bright.
    """

    width: jax.Array
    content: jax.Array
    slopes: jax.Array


class Taken(NamedTuple):
    """How a camera takes a view."""

    gain: jax.Array | None  # `[3]` over the middle exposure; None: predicted from the render
    curve: jax.Array | None  # `[L]` light of its colors; None: that of sRGB


class Exposures(struct.PyTreeNode):
    """Exposures of V photographs.

    Attributes:
      log_gains: `[V, 3]` logarithms of gains, 0 on average.
      metering: how the camera chose them.
      stated: `[3]` log gains of held-out photographs whose files state their exposure, by split and
        name.
      curves: `[L]` light of the colors of each camera whose curve is not that of sRGB.
      cameras: by split and name of a photograph, which camera took it.
    """

    log_gains: jax.Array
    metering: Metering
    stated: Mapping[str, Mapping[str, jax.Array]] = struct.field(default_factory=dict)
    curves: Mapping[str, jax.Array] = struct.field(default_factory=dict)
    cameras: Mapping[str, Mapping[str, str]] = struct.field(pytree_node=False, default_factory=dict)

    def train_curves(self, names: Sequence[str]) -> jax.Array | None:
        """Return the curves `[V, L]` of training photographs; None where all are that of sRGB."""
        cameras = self.cameras.get("train", {})
        return stack_curves(self.curves, [cameras[name] for name in names]) if cameras else None

    def curve_of(self, split: str | None, name: str | None) -> jax.Array | None:
        """Return the curve of a photograph's camera; of one that is not known, of the usual one."""
        took = collections.Counter(self.cameras.get("train", {}).values())
        camera = self.cameras.get(split or "", {}).get(name or "")
        if took and camera not in took:
            camera = took.most_common(1)[0][0]
        return self.curves.get(camera or "")


def stack_curves(curves: Mapping[str, jax.Array], cameras: Sequence[str]) -> jax.Array:
    """Return the curves `[V, L]` of V photographs by their cameras; some may be that of sRGB."""
    levels = len(next(iter(curves.values())))
    srgb = to_light(jnp.linspace(0, 1, levels))
    return jnp.stack([curves.get(camera, srgb) for camera in cameras])


def look_at_points(
    camera: Camera,
    depth: jax.Array,
    rgb: jax.Array,
    weight: jax.Array,
    points: jax.Array,
    *,
    tolerance: float = 0.02,
) -> jax.Array:
    """Return log light `[P, 3]` of world points in one photograph; NaN where it shows none.

    Args:
      camera: camera of the photograph.
      depth: `[H, W]` its z-depth; 0 is undefined.
      rgb: `[H, W, 3]` float colors.
      weight: `[H, W]` its weights.
      points: `[P, 3]`.
      tolerance: relative difference of depths up to which the photograph shows a point.
    """
    pixels, expected = points_to_pixels(camera, points)
    observed = backward_warp(jnp.stack([depth, weight], -1), pixels, order=0)
    colors = backward_warp(rgb, pixels)
    seen = in_bounds(pixels, *depth.shape) & (observed[:, 1] > 0) & reads_unmixed(weight, pixels)
    seen &= depth_consistent(observed[:, 0], expected, tolerance)
    seen &= (jnp.min(colors, -1) > USABLE[0]) & (jnp.max(colors, -1) < USABLE[1])
    return jnp.where(seen[:, None], jnp.log(to_light(jnp.maximum(colors, USABLE[0]))), jnp.nan)


def solve_gains(logs: np.ndarray, expected: np.ndarray | float = 0.0) -> np.ndarray:
    """Return log gains `[V, 3]` of photographs, 0 on average, from what they show of points.

    Minimizes the sum of |logs[v, p] - gains[v] - colors[p]| by reweighted least squares without the
    colors: what differs with the direction of view then hardly counts.

    Args:
      logs: `[V, P, 3]` log light; NaN where a photograph does not show a point.
      expected: `[V, 1 or 3]` log gains near which photographs stay that share few points.
    """
    logs = logs - np.asarray(expected)[..., None, :] if np.ndim(expected) else logs
    known = np.isfinite(logs).all(axis=-1)
    logs, weight = np.where(known[..., None], logs, 0).astype(np.float64), known.astype(np.float64)
    gains = np.zeros((len(logs), 3))
    for _ in range(_ROUNDS):
        total = np.maximum(weight.sum(axis=0), 1e-9)
        share = weight / total
        colors = np.einsum("vp,vpc->pc", share, logs)
        # A photograph that shares few points with others stays near what is expected.
        system = np.diag(weight.sum(axis=1) + _HELD) - share @ weight.T
        gains = np.linalg.solve(system, np.einsum("vp,vpc->vc", weight, logs - colors))
        colors -= share.T @ gains
        residual = np.linalg.norm(logs - gains[:, None] - colors, axis=-1)
        weight = known * _LEAST / np.maximum(residual, _LEAST)
    gains = gains + expected
    return gains - gains.mean(axis=0)


def meter(rgb: jax.Array, weight: jax.Array, width: jax.Array | float) -> jax.Array:
    """Return the log `[3]` of an image's mean light, as a camera meters it.

    Args:
      rgb: `[H, W, 3]` float colors.
      weight: `[H, W]` weights of the pixels, such as a render's opacity.
      width: see `Metering`.
    """
    y, x = ((jnp.arange(size, dtype=rgb.dtype) + 0.5) / size - 0.5 for size in weight.shape)
    middle = jnp.exp(-0.5 * (x[None] ** 2 + y[:, None] ** 2) / width**2)
    share = (weight * middle)[..., None]
    light = safe_divide(jnp.sum(share * to_light(rgb), axis=(0, 1)), jnp.sum(share))
    return jnp.log(jnp.maximum(light, 1e-6))


class _Fit(NamedTuple):
    """A regression of gains on what was metered."""

    slopes: list[float]
    error: float  # left out one by one


def fit_metering(
    log_gains: np.ndarray, photographs: Sequence[tuple[jax.Array, jax.Array]]
) -> Metering:
    """Fit how a camera chose exposures, at the width that predicts left-out photographs best.

    A slope is 0, so that the middle is predicted, unless left-out photographs confirm it.
    Photographs that are black or fully masked do not count.

    Args:
      log_gains: `[V, 3]`.
      photographs: colors `[H, W, 3]` and weights `[H, W]` of each, as they were taken.
    """
    metered = jax.jit(meter)
    seen = np.array(
        [[np.asarray(metered(*image, width)) for image in photographs] for width in _WIDTHS],
        np.float64,
    )
    # Logarithms of no light lie so far from the others that they alone would make the slope.
    lit = (seen > np.log(_BLACK)).all(axis=(0, 2))
    if not lit.any():
        return Metering(jnp.float32(_WIDTHS[0]), jnp.zeros(3), jnp.zeros(2))
    found = []
    for width, contents in zip(_WIDTHS, seen[:, lit] - log_gains[lit], strict=True):
        found.append((_fit(contents, log_gains[lit]), width, contents.mean(axis=0)))
    fit, width, content = min(found, key=lambda one: one[0].error)
    return Metering(*(jnp.asarray(a, jnp.float32) for a in (width, content, fit.slopes)))


def _fit(content: np.ndarray, log_gains: np.ndarray) -> _Fit:
    """Return slopes and their error for gains `[V, 3]` and metered content `[V, 3]`."""
    slopes, total = [], 0.0
    if len(content) < 2:
        return _Fit([0.0, 0.0], 0.0)  # nothing to compare with
    for x, y in zip(_parts(content), _parts(log_gains), strict=True):
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        squares, count = (x**2).sum(), len(x)
        slope = float((x * y).sum() / max(squares, 1e-12))
        # The share of each photograph in its own prediction.
        own = 1 / count + (x**2).sum(axis=1, keepdims=True) / max(squares, 1e-12)
        middle = ((y / (1 - 1 / count)) ** 2).mean()
        error = (((y - slope * x) / np.maximum(1 - own, 1e-3)) ** 2).mean()
        believed = error < _BETTER**2 * middle
        slopes.append(slope if believed else 0.0)
        total += float(error if believed else middle)
    return _Fit(slopes, total)


def _parts(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean `[V, 1]` of channels `[V, 3]`, and what they differ from it by."""
    mean = colors.mean(axis=-1, keepdims=True)
    return mean, colors - mean


def predict_gain(metering: Metering, rgb: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the gain `[3]` at which the camera would take a view, from its render.

    Args:
      metering: how the camera chooses.
      rgb: `[H, W, 3]` the view at the middle exposure.
      weight: `[H, W]` its opacity; the middle is predicted where it is 0.
    """
    total = jnp.sum(weight)
    safe = jnp.where(total > 0, weight, 1)
    beyond = meter(rgb, safe, metering.width) - metering.content
    mean = jnp.mean(beyond)
    log_gain = metering.slopes[0] * mean + metering.slopes[1] * (beyond - mean)
    return jnp.where(total > 0, jnp.exp(log_gain), 1)


def at_middle_exposure(
    views: Views, log_gains: jax.Array, curves: jax.Array | None = None
) -> Views:
    """Return photographs with float colors as they would be at the middle exposure.

    Args:
      views: V photographs.
      log_gains: `[V, 3]`.
      curves: `[V, L]` light of their cameras' colors; None: that of sRGB.
    """
    gains, rgb = jnp.exp(-log_gains)[:, None, None], to_float(views.rgb)
    if curves is None:
        return views.replace(rgb=change_exposure(rgb, gains))
    rows = jnp.arange(len(views))[:, None, None]
    return views.replace(rgb=to_colors(light_by_curve(rgb, curves, rows) * gains))


def take(rgb: jax.Array, taken: Taken) -> jax.Array:
    """Return colors `[..., 3]` of the middle exposure as a camera takes them; its gain is known."""
    assert taken.gain is not None
    light = to_light(rgb) * taken.gain.reshape((1,) * (rgb.ndim - 1) + (3,))
    return to_colors(light) if taken.curve is None else colors_by_curve(light, taken.curve)
