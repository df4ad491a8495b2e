"""Bad inputs that the tests of single modules do not cover."""

import json
import pathlib
import shutil
import warnings

import numpy as np
import pytest
from tiny_capture import (
    HEIGHT,
    WIDTH,
    colmap_capture,
    frame,
    image_line,
    llff_capture,
    llff_rows,
    paper_capture,
    single_file,
    write_image,
    write_model,
)
from tiny_capture import write_json as write_frames

from jaxcloseup.captures import photo_files as images
from jaxcloseup.captures.load import SceneError, load_scene


def changed(**changes):
    def make(folder):
        paper_capture(folder)
        frames = [frame("train/a.png") | changes, frame("train/b.png")]
        write_frames(folder / "transforms_train.json", frames)

    return make


def holding(name, data, make=paper_capture):
    """Make a capture in which the file `name` holds `data`: bytes, text or pixels."""

    def write(folder):
        make(folder)
        if isinstance(data, np.ndarray):
            write_image(folder / name, data)
        else:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())

    return write


def split_file(text):
    return holding("split.json", text, llff_capture)


def model(images=None, points=(), **changes):
    def make(folder):
        colmap_capture(folder, 2)
        lines = [image_line(1, "000.png"), ""] if images is None else images
        write_model(folder / "sparse/0", lines, points=points, **changes)

    return make


def without(name):
    def make(folder):
        colmap_capture(folder)
        path = folder / name
        path.unlink() if path.is_file() else shutil.rmtree(path)

    return make


def text_as_binary(folder):
    pycolmap = pytest.importorskip("pycolmap")
    colmap_capture(folder)
    model = folder / "sparse/0"
    found = pycolmap.Reconstruction()
    found.read_text(str(model))
    found.write_binary(str(model))
    (model / "cameras.bin").write_text("# Camera list\n1 PINHOLE 8 6 10 11 4 3\n" * 3)


def rows(change):
    def make(folder):
        llff_capture(folder)
        np.save(folder / "poses_bounds.npy", change(llff_rows(3)[0]), allow_pickle=True)

    return make


def infinite(values):
    values[1, 4] = np.inf
    return values


def two(folder):
    single_file(folder, 2)


def masked(value):
    def make(folder):
        two(folder)
        for name in ("000", "001"):
            write_image(folder / f"masks/{name}.png", np.full((HEIGHT, WIDTH), value, np.uint8))

    return make


def reduced(names, height=3, data=None):
    """Make a capture with `images_2`; `data` overwrites its last image."""

    def make(folder):
        two(folder)
        for name in names:
            write_image(
                folder / f"images_2/{name}.png", np.zeros((height, WIDTH // 2, 3), np.uint8)
            )
        if data is not None:
            (folder / f"images_2/{names[-1]}.png").write_bytes(data)

    return make


BLACK_3 = np.zeros((3, 3), np.uint8)
CLEAR = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
PIXEL = np.zeros((1, 1, 3), np.uint8)
HUGE_PLY = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\n"
    "property float y\nproperty float z\nend_header\n1234"
)
NULL_POSE = [[1, 0, 0, None], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (holding("transforms_train.json", "{}"), r'"frames" must be a list of objects'),
        (changed(file_path="train"), r"1 of 2 listed images do not exist \(train\)"),
        (changed(file_path="a\0b"), "1 of 2 listed images do not exist"),
        (changed(transform_matrix=NULL_POSE), "holds a value that is not finite"),
        (changed(transform_matrix=np.zeros((4, 4)).tolist()), "it may be transposed"),
        (changed(fx=None), "fx must be a finite number, got None"),
        (changed(mask_path="m.png"), r"m\.png cannot be read \(No such file"),
        (split_file('{"test": [["0.png"]]}'), r"test must be a list of the frames' name"),
        (split_file(b'{"test": ["\xe9.png"]}'), r"split\.json is not readable as JSON"),
        (holding("masks/000.png", "x", two), r"masks/000\.png is not a readable image"),
        (holding("masks/000.png", BLACK_3, two), "3 x 3 pixels but its photograph is 8 x 6"),
        (holding("images/000.mask.png", BLACK_3, two), r"images/000\.mask\.png is 3 x 3 pixels"),
        (holding("points3d.ply", HUGE_PLY), "ends before its 1000000000000 vertices do"),
        (model(cameras=[]), "do not match each other"),
        (model(points=["1 0 0 5 1 2 3 0.5 9 9"]), "do not match each other"),
        (without("sparse/0/points3D.txt"), r"points3D\.txt is missing"),
        (without("images"), "3 of 3 listed images do not exist"),
        (text_as_binary, r"cameras\.bin: camera \d+ has the unknown camera model"),
        (
            rows(lambda values: values.astype(complex)),
            "holds complex128 values instead of real num",
        ),
        (rows(lambda values: np.array([{}], object)), "is truncated or not a NumPy file"),
        (rows(infinite), r"row of 1\.png: height must be a finite number, got inf"),
        (
            holding("images/9.png", PIXEL, llff_capture),
            r"has 3 poses but .*images has 4 photo",
        ),
    ],
)
def test_wrong_captures(tmp_path, make, message):
    make(tmp_path)
    if (tmp_path / "sparse").is_dir():
        pytest.importorskip("pycolmap")
    with pytest.raises(SceneError, match=message) as error:
        load_scene(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (masked(255), {"invert_masks": True}, "invert_masks keeps black pixels; leave it out if"),
        (masked(0), {}, "white pixels are kept; set invert_masks if"),
        (two, {"alpha_mode": "mask"}, "no photograph has transparent pixels: leave out alpha_m"),
        (
            holding("images/001.png", CLEAR, two),
            {"alpha_mode": "mask"},
            "only opaque pixels are kept, so leave out alpha_mode",
        ),
        (two, {"split": "zoom", "downscale": 2}, "downscale 2 times zoom 4 leaves nothing of it"),
        (reduced(["000", "001"], height=7), {"downscale": 2}, r"4 x 7 pixels, which is not 8 x 6"),
        (reduced(["000", "001"], data=b"x"), {"downscale": 2}, r"images_2/001\.png is not a read"),
    ],
)
def test_wrong_options(tmp_path, make, options, message):
    make(tmp_path)
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path, **options)


@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(17), None])
def test_broken_png(tmp_path, data, capfd):
    """An empty file, an image of 0 x 0 pixels, and a chunk with a wrong checksum."""
    paper_capture(tmp_path)
    path = tmp_path / "train/a.png"
    path.write_bytes(path.read_bytes().replace(b"IDAT", b"IDAX") if data is None else data)
    with pytest.raises(SceneError, match=r"train/a\.png is not a readable image"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("make", "options", "note"),
    [
        (changed(), {}, None),
        (holding("train/a.png", PIXEL), {}, None),
        (reduced(["000"]), {"downscale": 2}, "lacks 1 of 2 photographs, such as 001"),
        (lambda folder: single_file(folder, 1), {"split": "zoom"}, "unshrunk, 1 in all"),
    ],
)
def test_unusual_captures_load(tmp_path, make, options, note):
    make(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(tmp_path, **options)
    assert len(scene.train) in (1, 2)
    assert note is None or note in scene.metadata["notes"][-1]


def test_palette_images_load(tmp_path):
    image = pytest.importorskip("PIL.Image")
    paper_capture(tmp_path)
    picture = image.new("P", (WIDTH, HEIGHT), 1)
    picture.putpalette([0, 0, 0, 10, 20, 30])
    picture.save(tmp_path / "train/a.png")
    assert np.asarray(load_scene(tmp_path).train.rgb)[0, 0, 0].tolist() == [10, 20, 30]


def test_one_photograph_in_two_lists(tmp_path):
    llff_capture(tmp_path)
    lists = {"train": ["0.png", "1.png"], "test": ["1.png"]}
    (tmp_path / "split.json").write_text(json.dumps(lists))
    with pytest.warns(UserWarning, match=r"lists 1 photographs more than once: 1\.png \(train and"):
        load_scene(tmp_path)


def test_a_list_instead_of_a_path(tmp_path):
    paper_capture(tmp_path)
    write_frames(tmp_path / "transforms_train.json", [frame("train/a.png")], ply_file_path=["a"])
    with pytest.raises(SceneError, match=r"ply_file_path \['a'\] does not exist"):
        load_scene(tmp_path)


def test_unreadable_files(tmp_path, monkeypatch):
    """Simulate missing permissions, because root may read every file."""
    paper_capture(tmp_path)

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(images, "read_bytes", refuse)
        with pytest.raises(
            SceneError, match=r"train/.\.png cannot be read \(Permission denied\): r"
        ):
            load_scene(tmp_path)
    monkeypatch.setattr(pathlib.Path, "read_bytes", refuse)
    with pytest.raises(SceneError, match=r"transforms_train\.json cannot be read \(Permission den"):
        load_scene(tmp_path)
