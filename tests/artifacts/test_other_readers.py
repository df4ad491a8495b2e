"""Splats and meshes in formats of other programs, opened by other people's readers."""

import io
import json
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from reference_splats import rotation_of, sh_color
from splat_scenes import random_scene, to_surfels

from jaxcloseup.artifacts.compressed_ply import pack_compressed_ply
from jaxcloseup.artifacts.glb import TexturedMesh, pack_mesh_glb, pack_splats_glb
from jaxcloseup.artifacts.images import encode_png
from jaxcloseup.artifacts.spz import pack_spz
from jaxcloseup.io.placement import Placement


SAME, FLIP = np.eye(3), np.diag([1.0, -1, -1])
COUNT = 300  # more than a chunk
SPLATTING = "KHR_gaussian_splatting"


def splats(degree=1, num_scales=3):
    rng = np.random.default_rng(degree)
    surfels = to_surfels(random_scene(3, count=COUNT, num_scales=num_scales))
    sh = rng.uniform(-0.9, 0.9, size=(COUNT, (degree + 1) ** 2, 3))
    return surfels.replace(sh=jnp.asarray(sh, jnp.float32))


def pairs(means, surfels, *, flip=SAME):
    """Rows of the surfels that are nearest to means in a file, each once."""
    away = np.linalg.norm(means[:, None] - (np.asarray(surfels.means) @ flip)[None], axis=-1)
    rows = away.argmin(axis=1)
    assert len(set(rows)) == len(means)
    return rows


def covariances(quaternions, log_scales):
    axes = np.stack([rotation_of(np.asarray(q, np.float64)) for q in quaternions])
    axes = axes * np.exp(np.asarray(log_scales, np.float64))[:, None]
    return axes @ axes.swapaxes(1, 2)


def sizes(covariance):
    return np.linalg.norm(covariance, axis=(1, 2))[:, None, None]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gsply_reads_compressed_ply(degree, tmp_path):
    gsply = pytest.importorskip("gsply")
    surfels = splats(degree)
    alive = np.arange(COUNT) != 7
    packed, dropped = pack_compressed_ply(surfels, jnp.asarray(alive))
    file = tmp_path / "a.compressed.ply"
    file.write_bytes(packed)
    found = gsply.plyread(file)
    rows = pairs(found.means, surfels)
    assert dropped == 0 and set(rows) == set(np.flatnonzero(alive))
    taken = {name: np.asarray(array)[rows] for name, array in vars(surfels).items()}
    span = np.ptp(taken["means"], axis=0)
    assert np.all(np.abs(found.means - taken["means"]) <= span / 1023)
    np.testing.assert_allclose(found.scales, taken["log_scales"], atol=4 / 1023)
    true = covariances(taken["quaternions"], taken["log_scales"])
    read = covariances(found.quats, found.scales)
    assert np.all(np.abs(read - true) < 0.02 * sizes(true))
    opacities = 1 / (1 + np.exp(-taken["opacity_logits"]))
    np.testing.assert_allclose(1 / (1 + np.exp(-found.opacities)), opacities, atol=1 / 500)
    np.testing.assert_allclose(found.sh0, taken["sh"][:, 0], atol=0.01)
    if degree:
        np.testing.assert_allclose(found.shN, taken["sh"][:, 1:], atol=8 / 500)


def test_gsply_reads_spz(tmp_path):
    gsply = pytest.importorskip("gsply")
    surfels = splats()
    (tmp_path / "a.spz").write_bytes(pack_spz(surfels, jnp.ones(COUNT, bool))[0])
    found = gsply.read_spz(tmp_path / "a.spz")
    rows = pairs(found.means, surfels, flip=FLIP)
    np.testing.assert_allclose(found.scales, np.asarray(surfels.log_scales)[rows], atol=1 / 31)


def test_compressed_ply_is_placed_and_says_what_it_leaves_out():
    placement = Placement(np.array([4e6, 0, 1e5]), 2.0)
    packed, _ = pack_compressed_ply(splats(), jnp.ones(COUNT, bool), placement=placement)
    header, _, body = packed.partition(b"end_header\n")
    x, y, z = placement.offset
    assert f"comment add offset {x:.15g} {y:.15g} {z:.15g}\n".encode() in header
    low = np.frombuffer(body, "<f4", 18)[:3]
    assert np.all(np.abs(low) < 1e3)
    nothing, _ = pack_compressed_ply(splats(), jnp.zeros(COUNT, bool))
    assert b"element chunk 0\n" in nothing and b"element vertex 0\n" in nothing


def read_glb(packed):
    """Read a file's JSON and the arrays of its accessors, as the glTF specification says."""
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", packed)
    assert (magic, version, total, kind) == (b"glTF", 2, len(packed), b"JSON")
    fields = json.loads(packed[20 : 20 + length])
    size, kind = struct.unpack_from("<I4s", packed, 20 + length)
    buffer = packed[28 + length :]
    assert kind == b"BIN\0" and size == len(buffer) == fields["buffers"][0]["byteLength"]
    arrays = []
    for accessor in fields["accessors"]:
        view = fields["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        data = buffer[view["byteOffset"] :][: view["byteLength"]]
        width = int(accessor["type"][-1]) if accessor["type"] != "SCALAR" else 1
        arrays.append(np.frombuffer(data, kind).reshape(accessor["count"], width))
    return fields, arrays


@pytest.mark.parametrize(("degree", "num_scales"), [(0, 3), (2, 2)])
def test_a_glb_of_splats_has_what_the_extension_asks_for(degree, num_scales):
    surfels = splats(degree, num_scales)
    packed, dropped = pack_splats_glb(surfels, jnp.ones(COUNT, bool))
    fields, arrays = read_glb(packed)
    primitive = fields["meshes"][0]["primitives"][0]
    assert dropped == 0 and fields["extensionsUsed"] == [SPLATTING]
    assert primitive["mode"] == 0
    about = primitive["extensions"][SPLATTING]
    assert (about["kernel"], about["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    found = {name: arrays[i] for name, i in primitive["attributes"].items()}
    coefficients = np.stack(
        [
            found.pop(f"{SPLATTING}:SH_DEGREE_{band}_COEF_{m}")
            for band in range(degree + 1)
            for m in range(2 * band + 1)
        ],
        axis=1,
    )
    names = {f"{SPLATTING}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")}
    assert set(found) == names | {"POSITION", "COLOR_0"}
    np.testing.assert_allclose(found["POSITION"], np.asarray(surfels.means) @ FLIP, rtol=1e-6)
    ends = fields["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(ends["min"], found["POSITION"].min(axis=0))
    rotations = found[f"{SPLATTING}:ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, rtol=1e-6)
    scales = np.log(found[f"{SPLATTING}:SCALE"])
    np.testing.assert_allclose(scales[:, :num_scales], surfels.log_scales, rtol=1e-4, atol=1e-4)
    true = covariances(surfels.quaternions, scales)
    read = covariances(rotations[:, [3, 0, 1, 2]], scales)
    np.testing.assert_allclose(read, FLIP @ true @ FLIP, atol=1e-5)
    opacities = 1 / (1 + np.exp(-np.asarray(surfels.opacity_logits)))
    np.testing.assert_allclose(found[f"{SPLATTING}:OPACITY"][:, 0], opacities, rtol=1e-5)
    # A direction in the new frame has the color that it had in the old one.
    direction = np.array([0.48, -0.6, 0.64])
    for row in range(0, COUNT, 50):
        before = sh_color(np.asarray(surfels.sh[row], np.float64), direction)
        after = sh_color(coefficients[row].astype(np.float64), FLIP @ direction)
        np.testing.assert_allclose(after, before, atol=1e-5)


def test_trimesh_opens_a_glb_of_splats_as_colored_points():
    trimesh = pytest.importorskip("trimesh")
    surfels = splats()
    packed, _ = pack_splats_glb(surfels, jnp.ones(COUNT, bool))
    (cloud,) = trimesh.load(io.BytesIO(packed), file_type="glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, np.asarray(surfels.means) @ FLIP, rtol=1e-6)
    assert cloud.colors.shape == (COUNT, 4)


def test_trimesh_opens_a_glb_of_a_mesh_with_its_texture():
    trimesh = pytest.importorskip("trimesh")
    texture = np.zeros((4, 8, 3), np.uint8)
    texture[:2, :4], texture[2:, 4:] = (250, 10, 10), (10, 10, 250)
    mesh = TexturedMesh(
        vertices=np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1.0]]),
        faces=np.array([[0, 1, 2]]),
        texture_places=np.array([[0.25, 0.25], [0.75, 0.75], [0.25, 0.75]]),
        texture=encode_png(texture),
    )
    placement = Placement(np.array([4e6, 0, 0]), 2.0)
    packed = pack_mesh_glb(mesh, placement=placement)
    (read,) = trimesh.load(io.BytesIO(packed), file_type="glb").geometry.values()
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.vertices, placement.to_file(mesh.vertices) @ FLIP)
    colors = read.visual.to_color().vertex_colors[:, :3]
    np.testing.assert_array_equal(colors, [[250, 10, 10], [10, 10, 250], [0, 0, 0]])
    assert read_glb(packed)[0]["nodes"][0]["extras"]["offset"] == placement.offset.tolist()
