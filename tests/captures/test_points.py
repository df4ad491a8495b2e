"""Points from PLY files."""

import numpy as np
import pytest
from tiny_capture import PROPERTIES, vertices, write_ply

from jaxcloseup.captures.load import SceneError
from jaxcloseup.captures.points import read_ply_points
from jaxcloseup.photos.scene import PointsWarning


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("color", ["u1", "u2", "f4"])
def test_ply_encodings(tmp_path, encoding, color):
    properties = [("blue", color), ("nx", "f4"), *PROPERTIES[:3][::-1], ("segment", "i4")]
    properties += [("red", color), ("green", color)]
    rows = vertices(properties)
    write_ply(tmp_path / "p.ply", rows, encoding, after=b"3 0 1 2\n")
    points, rgb, notes = read_ply_points(tmp_path / "p.ply")
    assert not notes
    scale = {"u1": 255, "u2": 65535, "f4": 1}[color]
    assert (points.dtype, rgb.dtype) == (np.float64, np.float32)
    np.testing.assert_allclose(points, np.stack([rows[axis] for axis in "xyz"], -1), rtol=1e-6)
    for channel, name in enumerate(("red", "green", "blue")):
        np.testing.assert_allclose(rgb[:, channel], rows[name] / scale, rtol=1e-5)


def test_ply_oddities(tmp_path):
    rows = vertices(PROPERTIES[:3])
    rows["y"][1] = np.nan
    write_ply(tmp_path / "p.ply", rows, "ascii", newline="\r\n")
    with pytest.warns(PointsWarning, match="1 of 5 points are not finite"):
        points, rgb, notes = read_ply_points(tmp_path / "p.ply")
    assert points.shape == (4, 3) and (rgb == 0.5).all()
    assert notes == ("p.ply has no colors: its points are gray",)
    rows = vertices([*PROPERTIES[:3], ("red", "f4"), ("green", "f4"), ("blue", "f4")])
    rows["red"] = 255
    write_ply(tmp_path / "p.ply", rows)
    assert (read_ply_points(tmp_path / "p.ply")[1][:, 0] == 1).all()
    write_ply(tmp_path / "p.ply", vertices(count=0))
    assert read_ply_points(tmp_path / "p.ply")[0].shape == (0, 3)


@pytest.mark.parametrize(
    ("names", "kind", "scale"),
    [
        ("diffuse_red diffuse_green diffuse_blue", "u1", 255),
        ("r g b", "f4", 1),
        ("red green blue", "u2", 255),  # values of 8 bits in fields of 16
        ("red green blue", "i4", 255),
        ("f_dc_0 f_dc_1 f_dc_2", "f4", np.sqrt(4 * np.pi)),  # and opacity, of a file of splats
    ],
)
def test_colors_of_other_programs(tmp_path, names, kind, scale):
    rows = vertices([*PROPERTIES[:3], *((name, kind) for name in names.split()), ("opacity", "f4")])
    values = np.random.default_rng(0).integers(0, 256, (3, len(rows))) / (
        255 if kind == "f4" else 1
    )
    for name, column in zip(names.split(), values, strict=True):
        rows[name] = column
    write_ply(tmp_path / "p.ply", rows)
    _, rgb, notes = read_ply_points(tmp_path / "p.ply")
    offset = 0.5 if "dc" in names else 0
    np.testing.assert_allclose(rgb.T, offset + values / scale, rtol=1e-5)
    assert not notes


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_cut_short_or_claiming_more(tmp_path, encoding):
    write_ply(tmp_path / "p.ply", vertices(), encoding)
    data = (tmp_path / "p.ply").read_bytes()
    for cut in (20, 60):
        (tmp_path / "p.ply").write_bytes(data[:-cut])
        with pytest.raises(SceneError, match=r"p\.ply ends before its 5 vertices do"):
            read_ply_points(tmp_path / "p.ply")
    for count in (10**12, 10**30):
        claim = b"vertex %d" % count
        (tmp_path / "p.ply").write_bytes(data.replace(b"vertex 5", claim))
        with pytest.raises(SceneError, match=f"ends before its {count} vertices do"):
            read_ply_points(tmp_path / "p.ply")
