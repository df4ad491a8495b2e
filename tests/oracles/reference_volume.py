"""Slow NumPy float64 oracles of volumetric fields, from the papers, without the package's code."""

import functools
import itertools
import math

import numpy as np


def resolution(level, levels, coarsest, finest):
    """Cells along a side of a level of the hash encoding (Instant-NGP, eq. 2 and 3)."""
    growth = math.exp((math.log(finest) - math.log(coarsest)) / max(1, levels - 1))
    return math.floor(coarsest * growth**level + 1e-6)


def hash_row(vertex, side, entries):
    """Row of a vertex `(x, y, z)` in its level's table (Instant-NGP, eq. 4); `side` vertices."""
    x, y, z = map(int, vertex)
    if side**3 <= entries:
        return x + side * y + side * side * z
    wrapped = [x * 1 % 2**32, y * 2654435761 % 2**32, z * 805459861 % 2**32]
    return (wrapped[0] ^ wrapped[1] ^ wrapped[2]) % entries


def hash_encoding(table, config, position):
    """Features `[L, F]` of one position in [0, 1]^3, and what each row of the table weighs."""
    table, entries = np.asarray(table, np.float64), 2**config.log2_entries
    found, shares, start = [], {}, 0
    for level in range(config.levels):
        cells = resolution(level, config.levels, config.coarsest, config.finest)
        scaled = np.clip(np.asarray(position, np.float64), 0, 1) * cells
        low = np.minimum(np.floor(scaled), cells - 1)
        total = np.zeros(table.shape[1])
        for corner in np.ndindex(2, 2, 2):
            share = np.prod([t if c else 1 - t for c, t in zip(corner, scaled - low, strict=True)])
            row = start + hash_row(low + corner, cells + 1, entries)
            total += share * table[row]
            shares[level, row] = shares.get((level, row), 0) + share
        found.append(total)
        start += min((cells + 1) ** 3, entries)
    assert start == len(table)
    return np.array(found), shares


def mlp(layers, *inputs):
    """Outputs `[M, O]` of linear layers with positive parts between them, of inputs `[M, I_i]`."""
    x = np.concatenate(inputs, axis=1)
    for i, layer in enumerate(layers):
        weights = np.concatenate([np.asarray(w, np.float64) for w in layer["weights"]], axis=1)
        x = x @ weights.T + np.asarray(layer["bias"], np.float64)
        x = np.maximum(x, 0) if i + 1 < len(layers) else x
    return x


def positional(x, octaves):
    """`[M, 3 + 6 octaves]`: x, sin x, cos x, sin 2x, ... of `[M, 3]`."""
    waves = [wave(2**k * x) for k in range(octaves) for wave in (np.sin, np.cos)]
    return np.concatenate([x, *waves], axis=1)


def contract(x):
    """mip-NeRF 360, eq. 10, of `[M, 3]`."""
    norm = np.linalg.norm(x, axis=1, keepdims=True)
    return np.where(norm <= 1, x, (2 - 1 / np.maximum(norm, 1e-9)) * x / np.maximum(norm, 1e-9))


def power(x, p):
    """The power transformation of Zip-NeRF, eq. 24, with its limits."""
    if p == 1:
        return x
    if p == 0:
        return np.log(x + 1)
    return abs(p - 1) / p * ((x / abs(p - 1) + 1) ** p - 1)


def unspace(s, near, far, p):
    """Distances in [near, far] at evenly transformed `s` in [0, 1], by bisection."""
    result = []
    for value in np.ravel(s):
        low, high = near, far
        for _ in range(100):
            middle = (low + high) / 2
            here = (power(middle, p) - power(near, p)) / (power(far, p) - power(near, p))
            low, high = (middle, high) if here < value else (low, middle)
        result.append((low + high) / 2)
    return np.reshape(result, np.shape(s))


def quantile_edges(edges, weights, count):
    """`count + 1` edges of equal shares of a histogram raised by 1e-5."""
    weights = np.asarray(weights, np.float64) + 1e-5
    cdf = np.concatenate([[0], np.cumsum(weights / weights.sum())])
    return np.interp(np.arange(count + 1) / count, cdf, edges)


def absorb(density, edges, length):
    """Weights of intervals of constant density along one ray, one after the other."""
    light, weights = 1.0, []
    for sigma, begin, end in zip(density, edges[:-1], edges[1:], strict=True):
        kept = math.exp(-sigma * (end - begin) * length)
        weights.append(light * (1 - kept))
        light *= kept
    return np.array(weights)


def proposal_penalty(edges, weights, proposed_edges, proposed):
    """mip-NeRF 360, eq. 11 to 13, with loops."""
    total = 0.0
    for i, weight in enumerate(weights):
        bound = 0.0
        for j, other in enumerate(proposed):
            apart = proposed_edges[j + 1] <= edges[i] or proposed_edges[j] >= edges[i + 1]
            bound += 0 if apart else other
        total += max(0, weight - bound) ** 2 / (weight + 1e-7)
    return total


def distortion(edges, weights, steps=4000):
    """mip-NeRF 360, eq. 14: the integral of w(u) w(v) |u - v|, by a sum over a fine grid."""
    grid = edges[0] + (np.arange(steps) + 0.5) * (edges[-1] - edges[0]) / steps
    bins = np.searchsorted(edges, grid, side="right") - 1
    mass = (weights / np.diff(edges))[bins] * (edges[-1] - edges[0]) / steps
    # The sum over pairs, by prefix sums over the ascending grid.
    before = np.cumsum(mass) - mass
    moment = np.cumsum(mass * grid) - mass * grid
    return 2 * np.sum(mass * (grid * before - moment))


def pixel_ray(camera, pixel):
    """Origin, direction of unit camera-z and its length, of one pixel."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics, np.float64)
    pose = np.asarray(camera.camtoworld, np.float64)
    direction = pose[:, :3] @ [(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, 1.0]
    return pose[:, 3], direction, np.linalg.norm(direction)


def march(camera, pixel, near, far, rounds, *, spacing=1.0, scale=1.0, blur=lambda w: w):
    """One pixel's color, depth and alpha, and the histograms of all rounds.

    `rounds` are pairs of a number of intervals and `look(origin, direction, edges) -> density, rgb`
    per world unit; origin and direction are in the world. `spacing` is that of distances times
    `scale`.
    """
    origin, direction, length = pixel_ray(camera, pixel)
    edges, weights, histograms = None, None, []
    for count, look in rounds:
        if edges is None:
            edges = np.arange(count + 1) / count
        else:
            edges = quantile_edges(edges, blur(weights), count)
        depth = unspace(edges, scale * near, scale * far, spacing) / scale
        density, rgb = look(origin, direction, depth)
        weights = absorb(density, depth, length)
        histograms.append((edges, weights))
    middle = (depth[1:] + depth[:-1]) / 2
    alpha = weights.sum()
    return weights @ rgb, weights @ middle / alpha, alpha, histograms


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def ngp(config, params, center, scale, pixel):
    """`rounds` for `march`, of Instant-NGP with proposals."""
    del pixel

    def features(grid_config, table, points):
        x = (points - center) * scale
        x = contract(x) / 2 if config.contracted else x
        return np.array([hash_encoding(table, grid_config, (p + 1) / 2)[0].ravel() for p in x])

    def propose(origin, direction, depth):
        points = origin + (depth[1:, None] + depth[:-1, None]) / 2 * direction
        part = params["proposal"]
        raw = mlp(part["density"], features(config.proposal, part["grid"], points))
        return scale * np.exp(raw[:, 0]), None

    def render(origin, direction, depth):
        points = origin + (depth[1:, None] + depth[:-1, None]) / 2 * direction
        part = params["fine"]
        raw = mlp(part["density"], features(config.grid, part["grid"], points))
        seen = looking(direction, len(raw), config.direction_octaves)
        return scale * np.exp(raw[:, 0]), sigmoid(mlp(part["color"], raw, seen))

    proposals = [n for n in (config.num_coarse, config.num_middle) if n]
    return [*((n, propose) for n in proposals), (config.num_fine, render)]


def widen(weights):
    """mip-NeRF, section 3.1: the larger of each two neighbors, averaged, plus 0.01."""
    last, result = len(weights) - 1, []
    for k, own in enumerate(weights):
        left, right = weights[max(k - 1, 0)], weights[min(k + 1, last)]
        result.append((max(left, own) + max(own, right)) / 2 + 0.01)
    return np.array(result)


def frustum(begin, end, radius):
    """Mean and variance along a cone's axis, and variance across (mip-NeRF, eq. 7)."""
    m, h = (begin + end) / 2, (end - begin) / 2
    mean = m + 2 * m * h**2 / (3 * m**2 + h**2)
    along = h**2 / 3 - 4 / 15 * h**4 * (12 * m**2 - h**2) / (3 * m**2 + h**2) ** 2
    across = radius**2 * (m**2 / 4 + 5 * h**2 / 12 - 4 * h**4 / (15 * (3 * m**2 + h**2)))
    return mean, along, across


def softplus(x):
    return np.logaddexp(0, x)


def looking(direction, count, octaves):
    return positional(np.tile(direction / np.linalg.norm(direction), (count, 1)), octaves)


def mipnerf(config, params, center, scale, pixel, network):
    """`rounds` for `march`, of mip-NeRF, whose network's oracle is `network`."""

    def render(origin, direction, depth):
        origin, direction = (origin - center) * scale, direction * scale
        encoded = []
        for begin, end in itertools.pairwise(depth):
            mean, along, across = frustum(begin, end, 2 / math.sqrt(12) * pixel * scale)
            projected = np.outer(direction, direction)
            covariance = along * projected
            covariance += across * (np.eye(3) - projected / (direction @ direction))
            waves = []
            for k in range(config.position_octaves):
                kept = np.exp(-0.5 * 4**k * np.diag(covariance))
                at = 2**k * (origin + mean * direction)
                waves += [np.sin(at) * kept, np.cos(at) * kept]
            encoded.append(np.concatenate(waves))
        seen = looking(direction, len(encoded), config.direction_octaves)
        density, rgb = network(params, np.array(encoded), seen)
        return scale * softplus(density - 1), 1.002 * sigmoid(rgb) - 0.001

    return [(config.num_coarse, render), (config.num_fine, render)]


def zip_samples(origin, direction, begin, end, radius, count):
    """Points and deviations in a frustum (Zip-NeRF, eq. 1 to 3), for some axes across.

    Others than the paper's six are evenly spread, with the same variance along the ray.
    """
    m, h = (begin + end) / 2, (end - begin) / 2
    unit = direction / np.linalg.norm(direction)
    across = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    across /= np.linalg.norm(across)
    other = np.cross(unit, across)
    spread = np.linspace(-1, 1, count) if count > 1 else np.zeros(1)
    spread *= math.sqrt(0.6 / max(np.var(spread), 1e-9))
    for j, turn in enumerate((0, 2, 4, 3, 5, 1) if count == 6 else range(count)):
        root = math.sqrt((h**2 - m**2) ** 2 + 4 * m**4)
        t = end**2 + 2 * m**2 + spread[j] * root
        t = begin + h * t / (h**2 + 3 * m**2)
        angle, away = turn * 2 * math.pi / count, radius * t / math.sqrt(2)
        turned = math.cos(angle) * across + math.sin(angle) * other
        yield origin + t * direction + away * turned, 0.5 * away


def zipnerf(config, params, center, scale, pixel):
    """`rounds` for `march`, of Zip-NeRF."""

    def features(grid, points, table, origin, direction, depth):
        origin, direction = (origin - center) * scale, direction * scale
        result = []
        for begin, end in itertools.pairwise(depth):
            total = 0
            radius = 2 / math.sqrt(12) * pixel * scale
            for x, deviation in zip_samples(origin, direction, begin, end, radius, points):
                half = 1
                if config.contracted:
                    step, half = 1e-5, 2
                    moved = [contract(x[None] + sign * np.eye(3) * step) for sign in (1, -1)]
                    jacobian = (moved[0] - moved[1]) / (2 * step)
                    deviation *= np.cbrt(np.linalg.det(jacobian))
                    x = contract(x[None])[0]
                found, _ = hash_encoding(table, grid, 0.5 * x / half + 0.5)
                for level in range(grid.levels):
                    cells = resolution(level, grid.levels, grid.coarsest, grid.finest)
                    spread = 0.5 * deviation / half * cells
                    found[level] *= math.erf(1 / math.sqrt(8 * spread**2))
                total = total + found / points
            result.append(total.ravel())
        return np.array(result)

    def propose(part, origin, direction, depth):
        kind = config.proposal, config.proposal_points
        raw = mlp(part["density"], features(*kind, part["grid"], origin, direction, depth))
        return scale * np.exp(raw[:, 0]), None

    def render(origin, direction, depth):
        part = params["fine"]
        kind = config.grid, config.points
        raw = mlp(part["density"], features(*kind, part["grid"], origin, direction, depth))
        seen = looking(direction, len(raw), config.direction_octaves)
        return scale * np.exp(raw[:, 0]), sigmoid(mlp(part["color"], raw, seen))

    counts = [n for n in (config.num_coarse, config.num_middle) if n]
    proposals = [functools.partial(propose, part) for part in params["proposal"]]
    return [*zip(counts, proposals, strict=True), (config.num_fine, render)]


def blurred_penalty(edges, weights, proposed_edges, proposed, pulse, steps=200_001):
    """Zip-NeRF's interlevel loss, by a blur on a fine grid."""
    grid = np.linspace(edges[0] - 2 * pulse, edges[-1] + 2 * pulse, steps)
    cdf = np.interp(grid, edges, np.concatenate([[0], np.cumsum(weights)]))
    # The blurred density is a difference of the CDF, whose integral is again taken on the grid.
    ahead, behind = (np.interp(grid + sign * pulse, grid, cdf) for sign in (1, -1))
    density = (ahead - behind) / (2 * pulse)
    mass = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid))])
    blurred = np.diff(np.interp(proposed_edges, grid, mass))
    return np.sum(np.maximum(blurred - proposed, 0) ** 2 / (proposed + 1e-5))


def between(values, at):
    """Linear interpolation `[...]` of rows `[n, ...]` at a continuous row."""
    low = min(int(np.floor(at)), len(values) - 2)
    return (1 - (at - low)) * values[low] + (at - low) * values[low + 1]


def vector_matrix(factors, n, x):
    """Products `[3, C]` of matrices and vectors at a position in [-1, 1]^3 (TensoRF, eq. 4)."""
    u = np.clip((x + 1) / 2, 0, 1) * (n - 1)
    result = []
    for mode, (first, second, line) in enumerate(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
        plane = np.asarray(factors["planes"][mode], np.float64)[:n, :n]
        vector = np.asarray(factors["lines"][mode], np.float64)[:n]
        result.append(between(between(plane, u[first]), u[second]) * between(vector, u[line]))
    return np.array(result)


def tensorf(config, params, center, scale, pixel, vertices):
    """`rounds` for `march`, of TensoRF with grids of so many vertices a side."""
    del pixel

    def density(origin, direction, depth):
        points = origin + (depth[1:, None] + depth[:-1, None]) / 2 * direction
        x = (points - center) * scale
        total = np.array([vector_matrix(params["density"], vertices, p).sum() for p in x])
        return x, scale * config.density_scale * softplus(total + config.density_shift)

    def look(*ray):
        return density(*ray)[1], None

    def render(origin, direction, depth):
        x, absorbed = density(origin, direction, depth)
        products = np.array([vector_matrix(params["color"], vertices, p).ravel() for p in x])
        features = mlp(params["basis"], products)
        encoded = positional(features, config.octaves)
        seen = looking(direction, len(x), config.octaves)
        return absorbed, sigmoid(mlp(params["network"], encoded, seen))

    return [(config.num_coarse, look), (config.num_fine, render)]
