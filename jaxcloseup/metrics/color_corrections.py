"""PSNR after a correction of colors, as other programs fit it: for tables beside their numbers."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.geometry.numerics import safe_divide
from jaxcloseup.metrics.image_metrics import in_single, psnr


HIGHEST = jax.lax.Precision.HIGHEST
_ROUNDS = 5  # of multinerf's fit
_CLIPPED = 0.5 / 255  # from black and white, colors that do not count in it
_REGULAR = 1e-7  # share of the largest singular value below which colors do not tell features apart
_FIRST, _SECOND = np.triu_indices(3)
_ROWS = 16  # of an image whose terms are in memory at once


def gsplat_cc_psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array) -> jax.Array:
    """Compute the PSNR after gsplat's affine correction of each channel.

    The fit is that of the image to the target, a * target + b, and its inverse corrects the image.
    Arguments as in `psnr`; a channel of one color stays as it is.
    """
    image, target, weight = in_single(image, target, weight)
    share = safe_divide(weight, jnp.sum(weight), fill=jnp.nan)[..., None]

    def mean(values: jax.Array) -> jax.Array:
        return jnp.sum(share * values, axis=(0, 1), keepdims=True)

    middle, target_middle = mean(image), mean(target)
    offset = target - target_middle
    slope = safe_divide(mean(offset * (image - middle)), mean(offset**2), fill=1)
    slope = jnp.where(jnp.abs(slope) < 1e-8, 1, slope)
    corrected = target_middle + (image - middle) / slope
    return psnr(jnp.clip(corrected, 0, 1), target, weight=weight)


def multinerf_cc_psnr(image: jax.Array, target: jax.Array, *, weight: jax.Array) -> jax.Array:
    """Compute the PSNR after multinerf's quadratic correction, fitted and applied five times.

    Each channel becomes a polynomial of all three, of degree 2, by least squares over pixels that
    are clipped neither before nor after. Arguments as in `psnr`.
    """
    image, target, weight = in_single(image, target, weight)
    usable = _is_usable(image)

    def correct(_: jax.Array, corrected: jax.Array) -> jax.Array:
        counted = usable & _is_usable(corrected) & _is_usable(target)
        return _fit_quadratic(corrected, target, jnp.where(counted, weight[..., None], 0))

    return psnr(jax.lax.fori_loop(0, _ROUNDS, correct, image), target, weight=weight)


def _is_usable(image: jax.Array) -> jax.Array:
    return (image >= _CLIPPED) & (image <= 1 - _CLIPPED)


def _fit_quadratic(image: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """Return an image corrected once; `weight` `[H, W, 3]` is of each channel's pixels."""
    # Centered colors span the same polynomials, and keep sums of 32 bits exact enough.
    middle = jnp.mean(image, axis=(0, 1))[None]

    def features(row: jax.Array) -> jax.Array:
        """Return the polynomials' terms `[10, W]` of a row of colors `[W, 3]`."""
        centered = (row - middle).T
        squares = centered[_FIRST] * centered[_SECOND]
        return jnp.concatenate([squares, centered, jnp.ones_like(centered[:1])])

    def count(row: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the sums of a row in the normal equations of each channel."""
        colors, wanted, counted = row
        terms = features(colors)
        weighted = terms[None] * counted.T[:, None]  # [3, 10, W]
        products = jnp.einsum("ciw,jw->cij", weighted, terms, precision=HIGHEST)
        return products, jnp.sum(weighted * (wanted - colors).T[:, None], axis=-1)

    # Row by row, as all terms of large images take a gigabyte, and one sum of 32 bits over all
    # pixels would lose too much.
    rows, reached = jax.lax.map(count, (image, target, weight), batch_size=_ROWS)
    system, reached = jnp.sum(rows, axis=0), jnp.sum(reached, axis=0)
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(system, axis1=1, axis2=2), 1e-12))
    system = system / (scale[..., None] * scale[:, None])
    inverse = jnp.linalg.pinv(system, rtol=_REGULAR, hermitian=True)
    solved = jnp.einsum("cij,cj->ci", inverse, reached / scale, precision=HIGHEST) / scale

    def change(row: jax.Array) -> jax.Array:
        return jnp.einsum("ci,iw->wc", solved, features(row), precision=HIGHEST)

    return jnp.clip(image + jax.lax.map(change, image, batch_size=_ROWS), 0, 1)
