"""The kernel of `rasterize`: blends the splats of all tiles, with a hand-written derivative.

Tiles are sorted by the length of their lists and processed in blocks of `B`. A block processes its
lists in chunks of `K` splats and evaluates a chunk at all `P` pixels of its tiles at once, in
arrays `[K, B, P]`; only the products along a list are sequential. The derivative walks the same
chunks back to front, so memory is linear in pixels and pairs, and all sums have one fixed order.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxcloseup.numerics import safe_divide
from jaxcloseup.splats.batching import broadcast_batch, merge_images, split_images
from jaxcloseup.splats.tiling import TileLists


ALPHA_MIN = 1 / 255  # the kernel skips fainter contributions
ALPHA_MAX = 0.99  # keeps a gradient for splats behind an opaque one
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance falls below this

# First columns of the packed table that chunks gather; the payload comes last.
ANCHOR, HOMOGRAPHY, OPACITY, LOW_PASS, RANGE, PAYLOAD = 0, 2, 11, 12, 13, 15
_EXACT = lax.Precision.HIGHEST


def pack(footprints) -> jax.Array:
    """Pack `Footprints` into one table `[N, C]`, whose rows the chunks gather."""
    columns = [
        footprints.anchor,
        footprints.homography.reshape(9, -1),
        footprints.opacity[None],
        lax.stop_gradient(footprints.low_pass)[None],
        lax.stop_gradient(footprints.inverse_depth),
        footprints.payload,
    ]
    return jnp.concatenate(columns).T


class _Trace(NamedTuple):
    """What the forward pass keeps for the derivative, per pixel of all blocks `[blocks, B, P]`."""

    transmittance: jax.Array  # behind the last drawn splat
    stop: jax.Array  # position in the list at which the pixel was finished
    reference: jax.Array  # inverse depth of the first drawn splat


class _Shade(NamedTuple):
    """One chunk's splats at every pixel, `[K, B, P]`."""

    alpha: jax.Array  # 0 where not drawn
    inverse_depth: jax.Array
    z: jax.Array
    u_numerator: jax.Array
    v_numerator: jax.Array
    rho: jax.Array
    on_plane: jax.Array  # bool: the disc, not the low-pass, gives rho
    clipped: jax.Array  # bool: the low-pass gives rho and the depth is clipped to the disc's range


def _shade(splats: jax.Array, x: jax.Array, y: jax.Array, near: float) -> _Shade:
    """Evaluate gathered table rows `[K, B, C]` (anchors local to the tile) at pixels `[P]`."""
    column = lambda i: splats[:, :, i, None]  # noqa: E731
    dx, dy = x[None, None] - column(ANCHOR), y[None, None] - column(ANCHOR + 1)
    u, v, w = (
        column(i) + column(i + 1) * dx + column(i + 2) * dy
        for i in (HOMOGRAPHY, HOMOGRAPHY + 3, HOMOGRAPHY + 6)
    )
    squared = u * u + v * v
    low_pass = column(LOW_PASS) * (dx * dx + dy * dy)
    # Compare rho without dividing; where w <= 0 the ray misses the plane and the low-pass counts.
    on_plane = (w > 0) & (squared <= low_pass * (w * w))
    low, high = column(RANGE), column(RANGE + 1)
    inverse = jnp.where(on_plane, w, jnp.clip(w, low, high))
    z = 1 / inverse
    rho = jnp.where(on_plane, squared * (z * z), low_pass)
    alpha = jnp.minimum(column(OPACITY) * jnp.exp(-0.5 * rho), ALPHA_MAX)
    alpha = jnp.where((alpha >= ALPHA_MIN) & (w * near <= 1), alpha, 0)
    return _Shade(alpha, inverse, z, u, v, rho, on_plane, ~on_plane & ((w < low) | (w > high)))


def _gather(table, lists: TileLists, tiles, position, chunk):
    """Table rows `[K, B, C]` of each tile's chunk, with local anchors, and splats `[K, B]`."""
    starts, counts, origins = tiles
    place = position + jnp.arange(chunk, dtype=jnp.int32)[:, None]
    inside = place < counts[None]
    # Past a list's end, take the splat at its start and give it opacity 0.
    index = lists.splats[starts[None] + jnp.where(inside, place, 0)]
    rows = table[index]
    anchor = rows[..., :HOMOGRAPHY] - origins[None].astype(table.dtype)
    opacity = jnp.where(inside, rows[..., OPACITY], 0)[..., None]
    rows = jnp.concatenate(
        [anchor, rows[..., HOMOGRAPHY:OPACITY], opacity, rows[..., OPACITY + 1 :]], axis=-1
    )
    return rows, index


def _pixels(tile: int, dtype) -> tuple[jax.Array, jax.Array]:
    """Pixel centers x and y `[P]` of a tile whose first corner is the origin."""
    centers = jnp.arange(tile, dtype=dtype) + 0.5
    return jnp.tile(centers, tile), jnp.repeat(centers, tile)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def blend_tiles(config, table: jax.Array, lists: TileLists) -> tuple[jax.Array, jax.Array]:
    """Blend splats front to back in all tiles; only `table` is differentiated.

    Args:
      config: a `RasterizeConfig`; static.
      table: `[N, C]` from `pack`.
      lists: result of `tile_lists` with the config's tile and block.

    Returns:
      Sums `[T, F + 4, P]` over splats of weight times payload, z, 1, and the first and second power
      of 1 / z minus its value at the pixel's first splat; and the median z-depth `[T, P]`. Tiles
      are in row-major order.
    """
    return _blend_forward(config, table, lists)[0]


def _blend_forward(config, table, lists):
    sums, median, trace = _batched_forward(config)(table, lists)
    return (sums, median), (table, lists, trace)


def _blend_backward(config, residuals, cotangents):
    return _batched_backward(config)(*residuals, cotangents), None


@functools.cache
def _batched_forward(config):
    """`_forward` that blends a batch of images as one image with more tiles.

    If `vmap` batched the loops instead, all images would wait for the slowest at every chunk.
    """
    forward = jax.custom_batching.custom_vmap(functools.partial(_forward, config))

    @forward.def_vmap
    def _(size, batched, table, lists):
        table, lists = merge_images(*broadcast_batch(size, batched, (table, lists)))
        return split_images(size, forward(table, lists)), (True, True, _Trace(True, True, True))

    return forward


@functools.cache
def _batched_backward(config):
    """`_backward` with the batching of `_batched_forward`."""
    backward = jax.custom_batching.custom_vmap(functools.partial(_backward, config))

    @backward.def_vmap
    def _(size, batched, table, lists, trace, cotangents):
        arguments = broadcast_batch(size, batched, (table, lists, trace, cotangents))
        table, lists = merge_images(*arguments[:2])
        more = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), arguments[2:])
        return split_images(size, backward(table, lists, *more)), True

    return backward


def _forward(config, table, lists):
    features = table.shape[1] - PAYLOAD
    x, y = _pixels(config.tile, table.dtype)

    def attenuate(product, alpha):
        # The product keeps falling once a pixel is finished, so the pixel stays finished.
        product = product - alpha * product
        return product, product

    def block(tiles):
        counts = tiles[1]
        longest = counts.max()

        def unfinished(state):
            position, product = state[:2]
            listed = (position < counts)[:, None]
            return (position < longest) & jnp.any((product >= TRANSMITTANCE_MIN) & listed)

        def step(state):
            position, product, *pixels, sums = state
            rows, _ = _gather(table, lists, tiles, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            before = product
            product, afters = lax.scan(attenuate, product, shade.alpha)
            weights, pixels = _walk_chunk(shade, before, afters, position, pixels)
            sums = _add_chunk(sums, weights, rows, shade, reference=pixels[2])
            return position + config.chunk, product, *pixels, sums

        shape = (len(counts), config.tile**2)
        ones, zeros = jnp.ones(shape, table.dtype), jnp.zeros(shape, table.dtype)
        stop = jnp.zeros(shape, jnp.int32)
        state = (jnp.int32(0), ones, ones, stop, zeros, zeros, (zeros,) * (features + 4))
        _, _, *trace, median, sums = lax.while_loop(unfinished, step, state)
        return jnp.stack(sums, axis=1), median, _Trace(*trace)

    sums, median, trace = lax.map(block, (lists.starts, lists.counts, lists.origins))
    in_order = lambda tiles: tiles.reshape((-1, *tiles.shape[2:]))[lists.slot]  # noqa: E731
    return in_order(sums), in_order(median), trace


def _walk_chunk(shade, before, afters, position, pixels):
    """Weights `[B, P]` of a chunk's splats, front to back, and the updated `pixels`.

    `pixels` are the remaining transmittance, stop and reference of `_Trace`, and the median depth.
    """
    remaining, stop, reference, median = pixels
    weights = []
    for k in range(afters.shape[0]):
        alpha, after = shade.alpha[k], afters[k]
        open_ = after >= TRANSMITTANCE_MIN
        weights.append(jnp.where(open_, alpha * before, 0))
        remaining = jnp.where(open_, after, remaining)
        stop = jnp.where(open_, position + (k + 1), stop)
        drawn = alpha > 0
        reference = jnp.where(drawn & (before == 1), shade.inverse_depth[k], reference)
        median = jnp.where(drawn & (before > 0.5), shade.z[k], median)
        before = after
    return weights, (remaining, stop, reference, median)


def _add_chunk(sums, weights, rows, shade, *, reference):
    """The sums of `blend_tiles`, one `[B, P]` for each channel, with a chunk's splats added."""
    # Splats in front of the first drawn one have weight 0, so one reference serves all.
    shifted = shade.inverse_depth - reference[None]
    channels = [rows[:, :, f, None] for f in range(PAYLOAD, rows.shape[-1])]
    channels += [shade.z, jnp.ones_like(shade.z), shifted, shifted * shifted]
    return tuple(
        total + sum(weights[k] * channel[k] for k in range(len(weights)))
        for total, channel in zip(sums, channels, strict=True)
    )


def _backward(config, table, lists, trace, cotangents):
    x, y = _pixels(config.tile, table.dtype)
    # Moments about the middle of a tile lose the fewest digits.
    middle = config.tile / 2
    basis = jnp.stack([jnp.ones_like(x), x - middle, y - middle], axis=1)

    def moments(values):
        sums = jnp.einsum("kbp,pm->kbm", values, basis, precision=_EXACT)
        return jnp.moveaxis(sums, -1, 0)

    def rows_bar(rows, shade, inverse_bar, scaled, payload):
        plane = jnp.where(shade.on_plane, scaled * shade.z, 0)
        return _assemble(
            rows,
            middle,
            u=moments(-plane * shade.z * shade.u_numerator),
            v=moments(-plane * shade.z * shade.v_numerator),
            w=moments(jnp.where(shade.clipped, 0, inverse_bar) + plane * shade.rho),
            low_pass=moments(jnp.where(shade.on_plane, 0, scaled)),
            clip=jnp.where(shade.clipped, inverse_bar * shade.inverse_depth**2, 0).sum(-1),
            scaled=scaled.sum(-1),
            payload=payload,
        )

    cotangents = tuple(bar[lists.tile] for bar in cotangents)

    def recede(carry, splat):
        behind, after = carry
        alpha, passing, worth = splat
        before = after * passing
        behind = behind + alpha * before * worth
        return (behind, before), (behind, before)

    def block(table_bar, tiles):
        *tiles, (sums_bar, median_bar), trace = tiles
        z_bar, _, first_bar, second_bar = (sums_bar[None, :, i] for i in range(-4, 0))

        def step(state):
            position, behind, after, table_bar = state
            rows, index = _gather(table, lists, tiles, position, config.chunk)
            shade = _shade(rows, x, y, config.near)
            place = position + jnp.arange(config.chunk, dtype=jnp.int32)[:, None, None]
            alpha = jnp.where(place < trace.stop[None], shade.alpha, 0)
            shifted = shade.inverse_depth - trace.reference[None]
            worth = _worth(rows, shade, shifted, sums_bar)
            passing = 1 / (1 - alpha)
            ends = (behind, after)
            (behind, after), (behinds, before) = lax.scan(
                recede, ends, (alpha, passing, worth), reverse=True
            )
            # Shift by one: the state behind a splat is the state in front of the next one.
            behinds = jnp.concatenate([behinds[1:], ends[0][None]])
            afters = jnp.concatenate([before[1:], ends[1][None]])
            weight = alpha * before
            # The median splat takes transmittance to 1/2, else it is the last drawn one.
            last = (afters <= 0.5) | (afters == trace.transmittance[None])
            median = (alpha > 0) & (before > 0.5) & last
            depth_bar = weight * z_bar + jnp.where(median, median_bar[None], 0)
            inverse_bar = weight * (first_bar + 2 * shifted * second_bar)
            inverse_bar = inverse_bar - shade.z * shade.z * depth_bar
            scaled = alpha * (before * worth - behinds * passing)  # d loss / d log(alpha)
            scaled = jnp.where(alpha < ALPHA_MAX, scaled, 0)
            payload = jnp.einsum("kbp,bfp->kbf", weight, sums_bar[:, :-4], precision=_EXACT)
            update = rows_bar(rows, shade, inverse_bar, scaled, payload)
            table_bar = table_bar.at[index.reshape(-1)].add(update.reshape(-1, table.shape[1]))
            return position - config.chunk, behind, after, table_bar

        longest = jnp.minimum(trace.stop.max(), tiles[1].max())
        position = (longest - 1) // config.chunk * config.chunk
        state = (position, jnp.zeros_like(median_bar), trace.transmittance, table_bar)
        return lax.while_loop(lambda state: state[0] >= 0, step, state)[-1], None

    tiles = (lists.starts, lists.counts, lists.origins, cotangents, trace)
    return lax.scan(block, jnp.zeros_like(table), tiles)[0]


def _worth(rows, shade, shifted, sums_bar):
    """Derivative `[K, B, P]` of the loss with respect to each splat's weight."""
    z_bar, alpha_bar, first_bar, second_bar = (sums_bar[None, :, i] for i in range(-4, 0))
    features = range(rows.shape[-1] - PAYLOAD)
    worth = sum(rows[:, :, PAYLOAD + f, None] * sums_bar[None, :, f] for f in features)
    worth = worth + alpha_bar + shade.z * z_bar
    return worth + shifted * (first_bar + shifted * second_bar)


def _assemble(rows, middle, *, u, v, w, low_pass, clip, scaled, payload):
    """Cotangents `[K, B, C]` of gathered table rows, from sums over the tile's pixels.

    The cotangents of the homography's u, v, w and of the low-pass come as moments `[3, K, B]`: sums
    of 1, x and y about `middle`.
    """
    ax, ay = rows[..., 0] - middle, rows[..., 1] - middle
    about_anchor = lambda m: (m[0], m[1] - ax * m[0], m[2] - ay * m[0])  # noqa: E731
    u, v, w, low_pass = map(about_anchor, (u, v, w, low_pass))
    slopes = rows[..., HOMOGRAPHY:OPACITY].reshape(*rows.shape[:2], 3, 3)[..., 1:]
    anchor_bar = [
        rows[..., LOW_PASS] * low_pass[1 + axis]
        - sum(bar[0] * slopes[..., i, axis] for i, bar in enumerate((u, v, w)))
        for axis in range(2)
    ]
    # A clipped depth moves with the anchor's depth, 1 / homography[2, 0].
    constant_bar = w[0] + safe_divide(clip, rows[..., HOMOGRAPHY + 6] ** 2)
    opacity_bar = safe_divide(scaled, rows[..., OPACITY])
    constants = [jnp.zeros_like(ax)] * (PAYLOAD - LOW_PASS)
    columns = [*anchor_bar, *u, *v, constant_bar, *w[1:], opacity_bar, *constants]
    return jnp.concatenate([jnp.stack(columns, axis=-1), payload], axis=-1)


blend_tiles.defvjp(_blend_forward, _blend_backward)
