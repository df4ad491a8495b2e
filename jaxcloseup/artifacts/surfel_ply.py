"""Read and write splats in the PLY layout that viewers and editors of Gaussian splats share.

The file stores values before activation: log scales, opacity logits, unnormalized quaternions.
Spherical harmonics above degree 0 are stored channel by channel, red first.
"""

import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np

from jaxcloseup.artifacts.viewer_gaussians import thickened
from jaxcloseup.fields.splats.surfels import Surfels
from jaxcloseup.geometry.rotations import quaternion_to_matrix
from jaxcloseup.io.placement import UNMOVED, Placement
from jaxcloseup.io.ply import PlyError, read_vertices, write_vertices


_matrices = jax.jit(quaternion_to_matrix)


def write_surfels(
    path: str | pathlib.Path,
    surfels: Surfels,
    alive: jax.Array,
    *,
    num_scales: int = 3,
    placement: Placement = UNMOVED,
) -> int:
    """Write the surfels that are alive, atomically.

    Args:
      path: path of the file.
      surfels: `N` surfels, or volumetric Gaussians.
      alive: `[N]` bool.
      num_scales: 3 for viewers of 3-D Gaussians, which surfels get a thickness of 1/1000 of the
        smaller radius for; 2 for viewers of discs.
      placement: of the surfels in the coordinates to write: `to_file`, as viewers read float32
        alone. By default they stay.

    Returns:
      The number of alive surfels that were dropped because a value is not finite.

    Raises:
      ValueError: `num_scales` is neither 2 nor 3, or is 2 of volumetric Gaussians.
      OSError: one sentence that names the path and the reason.
    """
    if num_scales not in (2, 3):
        raise ValueError(f"num_scales must be 2 or 3, got {num_scales}")
    surfels, alive = jax.device_get((surfels, alive))
    sh = np.asarray(surfels.sh, np.float32)
    scales = np.asarray(surfels.log_scales, np.float32) - np.float32(np.log(placement.scale))
    normals = np.asarray(_matrices(surfels.quaternions))[..., 2]
    if scales.shape[1] == 3:
        if num_scales == 2:
            raise ValueError("volumetric Gaussians have three scales: num_scales must be 3")
        normals = np.zeros_like(normals)  # as other programs write them
    if num_scales == 3:
        scales = thickened(scales)
    columns = {
        **dict(zip("xyz", placement.to_file(np.asarray(surfels.means)).T, strict=True)),
        **dict(zip(("nx", "ny", "nz"), normals.T, strict=True)),
        **_numbered("f_dc", sh[:, 0]),
        **_numbered("f_rest", sh[:, 1:].swapaxes(1, 2).reshape(len(sh), 3 * (sh.shape[1] - 1))),
        "opacity": surfels.opacity_logits,
        **_numbered("scale", scales),
        **_numbered("rot", np.asarray(surfels.quaternions)),
    }
    vertices = np.empty(len(sh), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertices[name] = column
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    write_vertices(path, vertices[alive & finite], offset=placement.offset)
    return int(np.sum(alive & ~finite))


def read_surfels(path: str | pathlib.Path, *, num_scales: int = 2) -> Surfels:
    """Read splats from a PLY file with two or three scales and spherical harmonics of degree 0-3.

    Args:
      path: path of the file.
      num_scales: 2 for surfels, which leave a third scale out; 3 for volumetric Gaussians, for
        which two scales get a thickness as in `write_surfels`.

    Raises:
      PlyError: the file is not a PLY file of splats; one sentence that says what to do.
    """
    vertices = read_vertices(path)
    constant, rest, scales, rotation = (
        _columns(vertices, stem) for stem in ("f_dc", "f_rest", "scale", "rot")
    )
    found = constant.shape[1], scales.shape[1], rotation.shape[1]
    bands = rest.shape[1] // 3
    if (
        found not in ((3, 2, 4), (3, 3, 4))
        or bands not in (0, 3, 8, 15)
        or rest.shape[1] % 3
        or "opacity" not in (vertices.dtype.names or ())
    ):
        raise PlyError(
            f"{path} lacks the properties of splats (f_dc_*, f_rest_*, opacity, scale_*, rot_*): "
            "export it again as Gaussian splats."
        )
    scales = scales[:, :2] if num_scales == 2 else thickened(scales)
    higher = rest.reshape(len(vertices), 3, bands).swapaxes(1, 2)
    return Surfels(
        means=jnp.asarray(np.stack([vertices[axis] for axis in "xyz"], axis=1), jnp.float32),
        log_scales=jnp.asarray(scales),
        quaternions=jnp.asarray(rotation),
        opacity_logits=jnp.asarray(vertices["opacity"].astype(np.float32)),
        sh=jnp.asarray(np.concatenate([constant[:, None], higher], axis=1)),
    )


def _numbered(stem: str, array: np.ndarray | jax.Array) -> dict[str, np.ndarray]:
    return {f"{stem}_{i}": column for i, column in enumerate(np.asarray(array).T)}


def _columns(vertices: np.ndarray, stem: str) -> np.ndarray:
    """Stack the properties `stem_0`, `stem_1`, ... by number as `[P, count]`."""
    numbers = sorted(
        int(match[1])
        for name in vertices.dtype.names or ()
        if (match := re.fullmatch(rf"{stem}_(\d+)", name))
    )
    columns = [vertices[f"{stem}_{i}"] for i in numbers]
    return np.array(columns, np.float32).reshape(len(columns), len(vertices)).T
