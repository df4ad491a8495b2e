"""Surfels to PLY and back, and the layout that other programs read."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of
from splat_scenes import random_scene, to_surfels

from jaxcloseup.artifacts.surfel_ply import read_surfels, write_surfels
from jaxcloseup.io.ply import PlyError


def by_hand(path):
    """Read the names and columns of a float-only little-endian PLY file with `struct` alone."""
    data = path.read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    rows = list(struct.iter_unpack(f"<{len(names)}f", body))
    assert len(rows) == count
    return names, {name: [row[i] for row in rows] for i, name in enumerate(names)}


@pytest.mark.parametrize(("num_scales", "own"), [(2, 2), (3, 2), (3, 3)])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trip_is_exact(tmp_path, num_scales, own, degree):
    rng = np.random.default_rng(degree)
    surfels = to_surfels(random_scene(1, num_scales=own))
    sh = rng.normal(size=(16, (degree + 1) ** 2, 3))
    surfels = surfels.replace(sh=jnp.asarray(sh, jnp.float32))
    alive = jnp.arange(16) % 3 > 0
    path = tmp_path / "deep" / "splats.ply"
    assert write_surfels(path, surfels, alive, num_scales=num_scales) == 0
    expected = jax.tree.map(lambda leaf: leaf[np.asarray(alive)], surfels)
    jax.tree.map(np.testing.assert_array_equal, read_surfels(path, num_scales=own), expected)


def test_the_file_has_the_layout_that_viewers_expect(tmp_path):
    surfels = to_surfels(random_scene(2))
    write_surfels(tmp_path / "s.ply", surfels, jnp.ones(16, bool))
    names, columns = by_hand(tmp_path / "s.ply")
    numbered = {"f_dc": 3, "f_rest": 9, "opacity": 0, "scale": 3, "rot": 4}
    expected = ["x", "y", "z", "nx", "ny", "nz"]
    for stem, count in numbered.items():
        expected += [f"{stem}_{i}" for i in range(count)] or [stem]
    assert names == expected
    for row in range(16):
        normal = [columns[name][row] for name in ("nx", "ny", "nz")]
        rotation = rotation_of(np.asarray(surfels.quaternions[row], float))
        np.testing.assert_allclose(normal, rotation[:, 2], atol=1e-6)
        # Channel by channel: three coefficients of red, then of green.
        assert columns["f_rest_1"][row] == surfels.sh[row, 2, 0]
        assert columns["f_rest_3"][row] == surfels.sh[row, 1, 1]
        thin = np.log(1e-3) + float(surfels.log_scales[row].min())
        assert columns["scale_2"][row] == pytest.approx(max(thin, -20), rel=1e-6)
        assert columns["opacity"][row] == surfels.opacity_logits[row]


def test_files_of_volumes_have_all_three_scales(tmp_path):
    volumes, alive = to_surfels(random_scene(2, num_scales=3)), jnp.ones(16, bool)
    write_surfels(tmp_path / "v.ply", volumes, alive)
    names, columns = by_hand(tmp_path / "v.ply")
    write_surfels(tmp_path / "s.ply", to_surfels(random_scene(2)), alive)
    assert names == by_hand(tmp_path / "s.ply")[0]  # the layout of discs for such viewers
    for i in range(3):
        np.testing.assert_array_equal(columns[f"scale_{i}"], volumes.log_scales[:, i])
    with pytest.raises(ValueError, match="three scales: num_scales must be 3"):
        write_surfels(tmp_path / "w.ply", volumes, alive, num_scales=2)
    flat = read_surfels(tmp_path / "s.ply", num_scales=3).log_scales
    np.testing.assert_allclose(flat[:, 2] - flat[:, :2].min(axis=1), np.log(1e-3), rtol=1e-5)


def test_surfels_that_are_not_finite_are_dropped_and_counted(tmp_path):
    surfels = to_surfels(random_scene(3))
    surfels = surfels.replace(means=surfels.means.at[jnp.array([2, 5])].set(jnp.nan))
    alive = jnp.ones(16, bool).at[5].set(False)
    assert write_surfels(tmp_path / "s.ply", surfels, alive) == 1
    assert len(read_surfels(tmp_path / "s.ply").means) == 14


def test_columns_are_read_by_their_numbers(tmp_path):
    surfels = to_surfels(random_scene(4))
    write_surfels(tmp_path / "s.ply", surfels, jnp.ones(16, bool))
    names, columns = by_hand(tmp_path / "s.ply")
    names = names[::-1]
    header = ["ply", "format ascii 1.0", "element vertex 16"]
    header += [f"property float {name}" for name in names]
    rows = [" ".join(repr(columns[name][i]) for name in names) for i in range(16)]
    (tmp_path / "t.ply").write_text("\n".join([*header, "end_header", *rows, ""]))
    jax.tree.map(np.testing.assert_array_equal, read_surfels(tmp_path / "t.ply"), surfels)


def test_other_point_clouds_are_refused(tmp_path):
    path = tmp_path / "p.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"{header}{properties}end_header\n1 2 3\n")
    with pytest.raises(PlyError, match=r"p.ply lacks the properties of splats"):
        read_surfels(path)
    with pytest.raises(ValueError, match="num_scales must be 2 or 3, got 4"):
        write_surfels(path, to_surfels(random_scene(0)), jnp.ones(16, bool), num_scales=4)
