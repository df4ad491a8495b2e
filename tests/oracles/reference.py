"""Slow NumPy float64 oracles, written from the equations; they share no code with the package."""

import numpy as np


def project(camtoworld, intrinsics, points):
    """Pixels `[N, 2]` and depths `[N]` of world points `[N, 3]`, one at a time."""
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    rotation = np.asarray(camtoworld, np.float64)[:, :3]
    position = np.asarray(camtoworld, np.float64)[:, 3]
    pixels, depths = [], []
    for point in np.asarray(points, np.float64):
        x, y, z = rotation.T @ (point - position)
        pixels.append([fx * x / z + cx, fy * y / z + cy])
        depths.append(z)
    return np.array(pixels), np.array(depths)


def unproject(camtoworld, intrinsics, pixels, depths):
    """World points `[N, 3]` of pixels `[N, 2]` at z-depths `[N]`, one at a time."""
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    rotation = np.asarray(camtoworld, np.float64)[:, :3]
    position = np.asarray(camtoworld, np.float64)[:, 3]
    points = []
    for (x, y), z in zip(np.asarray(pixels, np.float64), np.asarray(depths), strict=True):
        points.append(position + rotation @ np.array([(x - cx) / fx * z, (y - cy) / fy * z, z]))
    return np.array(points)


def forward_warp(values, pixels, depths, shape):
    """Z-buffer, one source after the other: `(values [H, W, C], depth [H, W])`, inf where empty."""
    height, width = shape
    image, buffer = np.zeros((height, width, values.shape[-1])), np.full(shape, np.inf)
    for value, (x, y), depth in zip(values, pixels, depths, strict=True):
        if 0 <= x < width and 0 <= y < height and 0 < depth < buffer[int(y), int(x)]:
            image[int(y), int(x)], buffer[int(y), int(x)] = value, depth
    return image, buffer


def bilinear(image, x, y):
    """Value `[C]` of an image `[H, W, C]` at one continuous pixel; the border repeats outwards."""
    height, width, _ = image.shape
    total = np.zeros(image.shape[-1])
    for column in (int(np.floor(x - 0.5)), int(np.floor(x - 0.5)) + 1):
        for row in (int(np.floor(y - 0.5)), int(np.floor(y - 0.5)) + 1):
            share = (1 - abs(x - 0.5 - column)) * (1 - abs(y - 0.5 - row))
            total += share * image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    return total


def warp_to(image, source, target, depth, source_depth=None, tolerance=0.02):
    """Read an image into a target view pixel by pixel; cameras are (camtoworld, intrinsics).

    Returns `image [H, W, C]`, `valid [H, W]` and `margin [H, W]`: how far the nearest decision is,
    in pixels, world units or relative depth.
    """
    image, depth = np.asarray(image, np.float64), np.asarray(depth, np.float64)
    height, width, channels = image.shape
    result, valid = np.zeros((*depth.shape, channels)), np.zeros(depth.shape, bool)
    margin = np.full(depth.shape, np.inf)
    for row, column in np.ndindex(*depth.shape):
        at = row, column
        if not (np.isfinite(depth[at]) and depth[at] > 0):
            continue
        point = unproject(*target, [(column + 0.5, row + 0.5)], [depth[at]])
        ((x, y),), (z,) = project(*source, point)
        margin[at] = min(abs(z), abs(x), abs(y), abs(x - width), abs(y - height))
        if z <= 0 or not (0 <= x < width and 0 <= y < height):
            continue
        if source_depth is not None:
            margin[at] = min(margin[at], abs(x - round(x)), abs(y - round(y)))
            error = abs(float(source_depth[int(y), int(x)]) - z)
            margin[at] = min(margin[at], abs(error / z - tolerance))
            if error > tolerance * z:
                continue
        result[at], valid[at] = bilinear(image, x, y), True
    return result, valid, margin


def composite_ray(rgb, density, depth, length):
    """Weights, color, alpha, depth, alpha times depth and median depth of one ray's samples."""
    rgb, density, depth = (np.asarray(x, np.float64) for x in (rgb, density, depth))
    transmittance, weights, median = 1.0, [], 0.0
    for i in range(len(density)):
        delta = depth[i + 1] - depth[i] if i + 1 < len(depth) else 1e10
        alpha = 1 - np.exp(-density[i] * delta * float(length))
        weights.append(transmittance * alpha)
        if transmittance >= 0.5 > transmittance * (1 - alpha):
            median = depth[i]
        transmittance *= 1 - alpha
    weights = np.array(weights)
    alpha, expected = weights.sum(), (weights * depth).sum()
    mean = expected / alpha if alpha > 0 else 0.0
    return weights, weights @ rgb, alpha, mean, expected, median


def invert_cdf(edges, weights, quantiles):
    """Positions at which the linear CDF of a histogram, raised by 1e-5, reaches `quantiles`."""
    edges, weights = np.asarray(edges, np.float64), np.asarray(weights, np.float64) + 1e-5
    cdf = np.concatenate([[0], np.cumsum(weights / weights.sum())])
    return np.interp(quantiles, cdf, edges)


def nerf_network(network, positions, directions):
    """Raw density `[M]` and rgb `[M, 3]` of encoded positions `[M, I]` and directions `[M, J]`."""

    def layer(params, x):
        weights = np.concatenate([np.asarray(w, np.float64) for w in params["weights"]], axis=1)
        return x @ weights.T + np.asarray(params["bias"], np.float64)

    h = positions
    for i, params in enumerate(network["trunk"]):
        if i > 0 and len(params["weights"]) == 2:
            h = np.concatenate([h, positions], axis=1)
        h = np.maximum(layer(params, h), 0)
    density = layer(network["density"], h)[:, 0]
    view = np.concatenate([layer(network["feature"], h), directions], axis=1)
    return density, layer(network["rgb"], np.maximum(layer(network["view"], view), 0))


def ssim_map(a, b):
    """SSIM `[H - 10, W - 10, 3]` of images `[H, W, 3]`, one Gaussian window at a time."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    height, width, channels = a.shape
    result = np.zeros((height - 10, width - 10, channels))
    for y, x, c in np.ndindex(*result.shape):
        p, q = (np.asarray(i, np.float64)[y : y + 11, x : x + 11, c] for i in (a, b))
        mean_p, mean_q = (window * p).sum(), (window * q).sum()
        var_p, var_q = (window * (p - mean_p) ** 2).sum(), (window * (q - mean_q) ** 2).sum()
        covariance = (window * (p - mean_p) * (q - mean_q)).sum()
        luminance = (2 * mean_p * mean_q + 0.01**2) / (mean_p**2 + mean_q**2 + 0.01**2)
        result[y, x, c] = luminance * (2 * covariance + 0.03**2) / (var_p + var_q + 0.03**2)
    return result


def first_crossing(solids, origin, direction, nearest=1e-4):
    """Depth, world normal and index of the nearest of `solids` = (kind, to_world, taper) on a ray.

    Kinds are "plane", "box", "sphere", "cylinder": unit shapes under an affine map `[3, 4]`. Each
    face is intersected by itself, in the unit frame. The last result is the least distance, in the
    unit frame, by which a candidate fell inside or outside its face: it is small for a grazing ray.
    """
    best, margin = (np.inf, np.zeros(3), -1), np.inf
    for index, (kind, to_world, taper) in enumerate(solids):
        to_world = np.asarray(to_world, np.float64)
        inverse = np.linalg.inv(to_world[:, :3])
        o, d = inverse @ (origin - to_world[:, 3]), inverse @ direction
        candidates = []  # (depth, unit normal, how far inside the face)
        if kind == "plane":
            t = -o[2] / d[2]
            candidates.append((t, [0, 0, 1], 1 - np.abs((o + t * d)[:2]).max()))
        if kind == "box":
            for axis in range(3):
                for sign in (-1, 1):
                    t = (sign - o[axis]) / d[axis]
                    inside = 1 - np.abs(np.delete(o + t * d, axis)).max()
                    candidates.append((t, sign * np.eye(3)[axis], inside))
        if kind == "sphere":
            roots = np.roots([d @ d, 2 * o @ d, o @ o - 1])
            margin = min(margin, abs((o @ o - 1) * (d @ d) - (o @ d) ** 2) / (d @ d))
            for t in roots[np.isreal(roots)].real:
                candidates.append((t, o + t * d, 1.0))
        if kind == "cylinder":
            w, slope = 1 + taper * o[2], taper * d[2]
            quadratic = [
                d[0] ** 2 + d[1] ** 2 - slope**2,
                2 * (o[0] * d[0] + o[1] * d[1] - w * slope),
                o[0] ** 2 + o[1] ** 2 - w**2,
            ]
            margin = min(margin, abs(quadratic[1] ** 2 - 4 * quadratic[0] * quadratic[2]) / (d @ d))
            roots = np.roots(quadratic)
            for t in roots[np.isreal(roots)].real:
                x, y, z = o + t * d
                candidates.append((t, [x, y, -taper * (1 + taper * z)], 1 - abs(z)))
            for end in (-1, 1):
                t = (end - o[2]) / d[2]
                x, y, _ = o + t * d
                candidates.append((t, [0, 0, end], 1 + end * taper - np.hypot(x, y)))
        for t, normal, inside in candidates:
            margin = min(margin, abs(inside))
            if inside >= 0 and nearest < t < best[0]:
                world = inverse.T @ normal
                world = world / np.linalg.norm(world)
                best = (t, -np.sign(world @ direction) * world, index)
    return (*best, margin)


def gather_view(
    point,
    side,
    position,
    camtoworld,
    intrinsics,
    inverse_depth,
    trust,
    levels,
    level_intrinsics,
    settings,
    finest,
):
    """What one photograph adds to one gathered point; None where it does not see it.

    Args:
      point: `[3]`; `side` is that of the view's pixel on the surface, 0 where undefined.
      position: `[3]` of the view.
      camtoworld: of the photograph, with `intrinsics`, `inverse_depth` and `trust` of its depth.
      levels: its values `[H, W, C]`, finest first, with `level_intrinsics` `[L, 4]`.
      settings: tolerance, angle_scale and finer.
      finest: first level to read.
    """
    if side <= 0:
        return None
    ((x, y),), (z,) = project(camtoworld, intrinsics, [point])
    height, width = trust.shape
    if z <= 0 or not (0 <= x < width and 0 <= y < height):
        return None
    inverse, sure = bilinear(np.stack([inverse_depth, trust], -1), x, y)
    off = (z * inverse - 1) / settings.tolerance
    seen = sure * max(1 - off**2, 0) ** 2
    if seen == 0:
        return None
    rays = [(point - eye) / np.linalg.norm(point - eye) for eye in (position, camtoworld[:, 3])]
    angle = np.arccos(min(np.dot(*rays), 1))
    footprints = [z / np.sqrt(fx * fy) / side for fx, fy, _, _ in level_intrinsics]
    footprint = footprints[finest]
    weight = seen * np.exp(-min(angle / settings.angle_scale, 20)) / max(footprint, 1) ** 2
    coarseness = [np.log2(other / footprints[0]) for other in footprints]
    wanted = -np.log2(footprints[0]) - settings.finer
    level = max(np.interp(wanted, coarseness, range(len(levels))), finest)
    value = 0
    for i, image in enumerate(levels):
        fx, fy, cx, cy = level_intrinsics[i]
        ((u, v),), _ = project(camtoworld, (fx, fy, cx, cy), [point])
        share = max(1 - abs(level - i), 0)
        value = value + share * bilinear(image, u, v) if share else value
    return {"w": weight, "value": value, "seen": seen, "footprint": footprint, "angle": angle}


def gather_mean(views, settings):
    """Weighted mean and statistics of what `gather_view` found of one point."""
    if not views:
        return {"weight": 0, "count": 0, "footprint": np.inf}
    w = np.array([view["w"] for view in views])
    values = np.stack([view["value"] for view in views])

    def mean(of):
        return np.tensordot(w, np.stack(of), 1) / w.sum()

    first = mean(values)
    variance = max(mean(np.mean(values**2, axis=1)) - np.mean(first**2), 0)
    found = {
        "variance": variance,
        "count": sum(view["seen"] for view in views),
        "footprint": min(view["footprint"] for view in views),
        "detail": mean([-np.log2(view["footprint"]) for view in views]),
        "angle": mean([view["angle"] for view in views]),
    }
    if settings.robust and variance > 1e-7:
        apart = np.mean((values - first) ** 2, axis=1) / variance
        w = w / (1 + settings.robust * apart) ** 2
        first = mean(values)
    return found | {"weight": w.sum(), "mean": first}
