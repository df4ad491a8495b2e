"""A slow splatter in NumPy float64: every splat at every pixel, no tiles.

Splats are discs, which rays meet, or with three scales volumetric Gaussians (at the end).

It shares neither code nor formulas with the package: it intersects rays with discs, while the
package interpolates homographies. Both follow the same decisions: the constants, the order (by
center depth, at least `near`), the low-pass about the projected center, and depth clipped to the
disc's own range where the low-pass counts.
"""

import numpy as np


ALPHA_MIN, ALPHA_MAX, T_MIN, LOW_PASS = 1 / 255, 0.99, 1e-4, 2.0


def rotation_of(wxyz):
    """Rotation matrix `[3, 3]` of one quaternion: its vector, as a cross product, in q v q*."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # np.cross takes ten times as long
    return np.eye(3) + 2 * (w * cross + cross @ cross)


def sh_color(sh, direction):
    """Color `[3]` of coefficients `[K, 3]` along a unit direction, with the basis as numbers."""
    x, y, z = direction
    basis = [
        0.28209479177387814,
        *(0.4886025119029199 * np.array([-y, z, -x])),
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.maximum(0.5 + np.array(basis[: len(sh)]) @ sh, 0)


def depth_reach(surfels, camtoworld):
    """Half the range of depth `[N]` that each disc covers, up to where it fades."""
    rotation = np.asarray(camtoworld)[:, :3]
    opacity = 1 / (1 + np.exp(-surfels["opacity_logits"]))
    cutoff = np.sqrt(2 * np.log(np.maximum(255 * opacity, 1)))
    reach = []
    for quaternion, log_scales in zip(surfels["quaternions"], surfels["log_scales"], strict=True):
        slopes = (rotation.T @ rotation_of(quaternion))[2, :2] * np.exp(log_scales)
        reach.append(np.hypot(*slopes))
    return cutoff * np.array(reach)


def intersect(surfels, camtoworld, intrinsics, pixels, *, near, reach=None, antialias=False):
    """Opacity and depth `[N, P]` of every surfel at `pixels[P, 2]`; opacity 0 is not drawn.

    With `antialias`, a disc in front of the camera is convolved with a pixel's variance of 1/12,
    carried onto the disc by the derivative at its center.

    Finite differences pass a fixed `reach`, because in the package a disc's range of depth has no
    derivative except that of its center.
    """
    rotation, position = np.asarray(camtoworld)[:, :3], np.asarray(camtoworld)[:, 3]
    fx, fy, cx, cy = intrinsics

    def ray_through(pixels):
        x, y = np.moveaxis(np.asarray(pixels), -1, 0)
        return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1)

    rays = ray_through(pixels)
    reach = depth_reach(surfels, camtoworld) if reach is None else reach
    alphas, depths = [], []
    for i in range(len(surfels["means"])):
        mu = rotation.T @ (surfels["means"][i] - position)
        tangent_u, tangent_v, normal = (rotation.T @ rotation_of(surfels["quaternions"][i])).T
        with np.errstate(divide="ignore", invalid="ignore"):
            z = normal @ mu / (rays @ normal)
            scales = np.exp(surfels["log_scales"][i])

            axes = np.stack([tangent_u, tangent_v], axis=1) / scales

            def local(rays, mu=mu, normal=normal, axes=axes):
                return ((normal @ mu / (rays @ normal))[:, None] * rays - mu) @ axes

            rho = np.sum(local(rays) ** 2, axis=-1)
        behind = ~(z > 0)
        rho = np.where(behind, np.inf, rho)
        opacity = 1 / (1 + np.exp(-surfels["opacity_logits"][i]))
        center = np.array([fx * mu[0] / mu[2] + cx, fy * mu[1] / mu[2] + cy])
        depth = z
        if antialias and mu[2] > near:
            # The derivative by a step along the imaginary axis, which takes no difference.
            slopes = local(ray_through(center + 1e-30j * np.eye(2))).imag / 1e-30
            covariance = np.eye(2) + slopes.T @ slopes / 12
            rho = np.einsum("pi,ij,pj->p", local(rays), np.linalg.inv(covariance), local(rays))
            rho = np.where(behind, np.inf, rho)
            opacity /= np.sqrt(np.linalg.det(covariance))
        elif mu[2] > near:
            floor = LOW_PASS * np.sum((pixels - center) ** 2, axis=-1)
            low, high = max(mu[2] - reach[i], near), max(mu[2] + reach[i], near)
            clipped = np.clip(np.where(behind, np.inf, z), low, high)
            depth = np.where(floor < rho, clipped, z)
            rho = np.minimum(rho, floor)
        alpha = np.minimum(opacity * np.exp(-rho / 2), ALPHA_MAX)
        hidden = (alpha < ALPHA_MIN) | ((z > 0) & (z < near))
        hidden |= abs(normal @ mu) <= 1e-4 * np.linalg.norm(mu)
        alphas.append(np.where(hidden, 0, alpha))
        depths.append(np.where(hidden, 1, depth))
    return np.array(alphas), np.array(depths)


def blend(alphas, depths, payload):
    """Blend splats one after the other; alphas and depths `[N, P]` are sorted front to back.

    Returns payload sums `[P, F]`, alpha, expected depth, median depth and distortion `[P]`.
    """
    count, size = alphas.shape
    transmittance, running = np.ones(size), np.ones(size, bool)
    weights, median = np.zeros((count, size)), np.zeros(size)
    for i in range(count):
        after = transmittance * (1 - alphas[i])
        running &= after >= T_MIN
        drawn = running & (alphas[i] > 0)
        weights[i] = np.where(drawn, alphas[i] * transmittance, 0)
        median = np.where(drawn & (transmittance > 0.5), depths[i], median)
        transmittance = np.where(drawn, after, transmittance)
    alpha = weights.sum(0)
    depth = np.divide((weights * depths).sum(0), alpha, out=np.zeros(size), where=alpha > 0)
    distortion = np.zeros(size)
    for i in range(count):
        for j in range(i):
            distortion += weights[i] * weights[j] * (1 / depths[i] - 1 / depths[j]) ** 2
    return weights.T @ payload, alpha, depth, median, distortion


def render(surfels, camtoworld, intrinsics, height, width, *, background=None, **options):
    """Images `[H, W, ...]` by name; `surfels` is a dictionary of float64 arrays.

    `options` are those of `intersect`.
    """
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    camtoworld = np.asarray(camtoworld, np.float64)
    volumetric = surfels["log_scales"].shape[1] == 3
    if volumetric:
        options.pop("reach", None)
        options["size"] = width, height
    draw = project if volumetric else intersect
    alphas, depths = draw(surfels, camtoworld, intrinsics, pixels, **options)
    payload, order = [], []
    for mean, quaternion, sh in zip(
        surfels["means"], surfels["quaternions"], surfels["sh"], strict=True
    ):
        offset = mean - camtoworld[:, 3]
        normal = rotation_of(quaternion)[:, 2]
        normal = normal if normal @ offset < 0 else -normal
        payload.append([*sh_color(sh, offset / np.linalg.norm(offset)), *normal])
        order.append(max(offset @ camtoworld[:, 2], options["near"]))
    by_depth = np.argsort(order, kind="stable")
    sums, alpha, depth, median, distortion = blend(
        alphas[by_depth], depths[by_depth], np.array(payload)[by_depth]
    )
    rgb = sums[:, :3] + (0 if background is None else (1 - alpha)[:, None] * background)
    image = dict(rgb=rgb, alpha=alpha, depth=depth, median_depth=median, distortion=distortion)
    image |= {} if volumetric else dict(normal=sums[:, 3:])
    return {name: value.reshape(height, width, *value.shape[1:]) for name, value in image.items()}


def project(gaussians, camtoworld, intrinsics, pixels, *, near, size, antialias=False):
    """Opacity and depth `[N, P]` of volumetric Gaussians, by matrices as Kerbl et al. wrote them.

    The image has `size` (width, height). An ellipse grows by 0.3 px^2; with `antialias` by 0.1,
    and its opacity falls as its area grows (Yu et al. 2024).
    """
    rotation, position = np.asarray(camtoworld)[:, :3], np.asarray(camtoworld)[:, 3]
    focal, principal = np.asarray(intrinsics)[:2], np.asarray(intrinsics)[2:]
    low = (-0.15 * np.array(size) - principal) / focal
    high = (1.15 * np.array(size) - principal) / focal
    alphas, depths = [], []
    for i, mean in enumerate(gaussians["means"]):
        x, y, z = mu = rotation.T @ (mean - position)
        axes = rotation_of(gaussians["quaternions"][i]) * np.exp(gaussians["log_scales"][i])
        covariance = rotation.T @ axes @ axes.T @ rotation
        # The derivative of the projection by steps along the imaginary axis.
        at = np.array([*np.clip([x / z, y / z], low, high), 1]) * z + 1e-30j * np.eye(3)
        jacobian = ((focal * at[:, :2] / at[:, 2:]).imag / 1e-30).T
        sharp = jacobian @ covariance @ jacobian.T
        wide = sharp + (0.1 if antialias else 0.3) * np.eye(2)
        opacity = 1 / (1 + np.exp(-gaussians["opacity_logits"][i]))
        if antialias:
            opacity *= np.sqrt(np.linalg.det(sharp) / np.linalg.det(wide))
        offset = pixels - (focal * mu[:2] / z + principal)
        rho = np.einsum("pi,ij,pj->p", offset, np.linalg.inv(wide), offset)
        alpha = np.minimum(opacity * np.exp(-rho / 2), ALPHA_MAX)
        alphas.append(np.where((alpha < ALPHA_MIN) | (z <= near), 0, alpha))
        depths.append(np.full(len(pixels), z if z > near else 1.0))
    return np.array(alphas), np.array(depths)
