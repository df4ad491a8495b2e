"""Captures that cannot be loaded: each is refused in one sentence that says what to do."""

import pathlib
import shutil
import warnings

import numpy as np
import pytest
from tiny_capture import HEIGHT, PINHOLE, POSE, WIDTH, frame, image_line, single_file, write_json
from wrong_input import (
    HEIC,
    IMAGES,
    TRAIN,
    all_of,
    binary,
    cell,
    colmap,
    edit,
    endless,
    fields,
    first,
    frames,
    llff,
    masked,
    model,
    paper,
    pipe,
    put,
    refused,
    remove,
    rows,
    single,
    soon,  # noqa: F401
    terabyte,
)

from jaxcloseup.captures import photo_files
from jaxcloseup.captures.load import SceneError, SceneWarning, load_scene
from jaxcloseup.photos.scene import (
    BlankPhotographWarning,
    DuplicateFileWarning,
    PointsWarning,
    UnknownKeyWarning,
)


pytestmark = pytest.mark.usefixtures("soon")

NAN, INF, HUGE = float("nan"), float("inf"), 10**400
TURN = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
PIXEL, BLACK = np.zeros((1, 1, 3), np.uint8), np.zeros((3, 3), np.uint8)
CLEAR, WHITE = np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.full((HEIGHT, WIDTH), 255, np.uint8)
NOT_ORDINARY, LARGE = "Not an ordinary file", r"More than (64|1024|4096) MiB"
NOT_NUMPY = r"poses_bounds\.npy is truncated or not a NumPy file"
MISMATCH = "do not match each other"


def pose(matrix):
    return first(transform_matrix=np.asarray(matrix).tolist())


def moved(*position):
    return pose(np.vstack([np.column_stack([POSE[:3, :3], position]), POSE[3]]))


def ply(count, body="", *, kind="ascii", properties="x y z"):
    lines = [f"ply\nformat {kind} 1.0\nelement vertex {count}"]
    lines += [f"property float {name}" for name in properties.split()]
    return put("points3d.ply", "\n".join([*lines, "end_header", body]))


def listing(**lists):
    """Name the photographs of each split in a single file."""
    return lambda folder: single_file(folder, 2, **lists)


def array_of(count):
    """A file of LLFF that claims so many rows and holds one."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({count}, 17), }}\n".encode()
    data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(17 * 8)
    return put("poses_bounds.npy", data)


def frame_quaternion(factor):
    old, new = np.float64([1, 0, 0, 0]), np.float64([factor, factor, 0, 0])
    return edit("sparse/0/frames.bin", lambda data: data.replace(old.tobytes(), new.tobytes()))


def without_line(index):
    return lambda data: b"\n".join(x for i, x in enumerate(data.split(b"\n")) if i != index)


def fewer_points(data):
    """Drop one of five points whose records are equally long."""
    size = (len(data) - 8) // 5
    return (4).to_bytes(8, "little") + data[8 : 8 + 4 * size]


# By format: a change, and a pattern of the sentence.
CASES = {
    paper: [
        (frames(), '"frames" is empty'),
        (put(TRAIN, {"frames": {}}), '"frames" must be a list'),
        (frames("a"), '"frames" must be a list of objects'),
        (first(without=["file_path"]), "a frame has no file_path"),
        (first(file_path=""), r"a frame has no file_path \(got ''\)"),
        (first(file_path=3), r"a frame has no file_path \(got 3\)"),
        (first(file_path="train"), r"1 of 2 listed images do not exist \(train\)"),
        (first(file_path="a\0b"), "1 of 2 listed images do not exist"),
        (first(file_path="a" * 5000), r"a cannot be read \(File name too long\)"),
        (frames(*map(frame, ("train/a.png", "x", "y"))), r"2 of 3 listed .* exist \(x, y\)"),
        (frames(*(frame(f"r_{i}") for i in range(4))), r"4 of 4 .*\(r_0, r_1, r_2, \.\.\.\)"),
        (first(mask_path=3), "mask_path is 3"),
        (first(mask_path="m.png"), r"m\.png cannot be read \(No such file"),
        # Poses.
        (first(without=["transform_matrix"]), "no transform_matrix"),
        (first(transform_matrix=[[1, 2], [3]]), "must be a 4x4 matrix"),
        (first(transform_matrix="x"), "must be a 4x4 matrix"),
        (pose(np.eye(3)), "must be a 4x4 matrix"),
        (first(transform_matrix=[[HUGE] * 4] * 4), "must be a 4x4 matrix"),
        (pose(np.eye(4) * np.nan), "not finite"),
        (first(transform_matrix=[[1, 0, 0, None], *np.eye(4)[1:].tolist()]), "not finite"),
        (pose(POSE.T), "may be transposed"),
        (pose(np.zeros((4, 4))), "may be transposed"),
        (pose((POSE * [[2]] * 3 + [[1]])[:3]), "rigid"),
        (pose(TURN * [1, 1, 1.01, 1]), "off by 0.02"),
        (pose(TURN * [1, 1, -1, 1]), "mirrors"),
        (moved(1e300, 0, 0), "transform_matrix holds a value that is not finite in 32 bits"),
        (moved(1e30, 0, 0), r"train/a\.png.*camera lies 1e\+30 from the origin: correct"),
        # Lenses and sizes.
        (first(fx=HUGE), "fx has 401 digits"),
        (first(fx=0), "fx must be greater than 0, got 0"),
        (first(fy=-3.0), "fy must be greater than 0"),
        (first(fx=None), "fx must be a finite number, got None"),
        (first(fx=NAN), "fx must be a finite number, got nan"),
        (first(cx=INF), "cx must be a finite number, got inf"),
        (first(cy="3"), "cy must be a finite number, got '3'"),
        (first(cy=True), "cy must be a finite number, got True"),
        (first(without=["fx", "fy"]), "no focal"),
        (first(without=["fx"], camera_angle_x=4.0), "camera_angle_x must be in radians, below pi"),
        (first(fx=1e39), r"fx is too large for 32 bits, 1e\+39: correct it"),
        (first(fx=1e-50), "fx must be greater than 0, got 1e-50"),
        (first(fx=1e31), r"of 1e\+31 pixels is not between 0\.01 and 10000 times the lon"),
        (first(fy=0.01), "a focal length of 0.01 pixels is not between"),
        (first(fx=1e31, k1=0.1), r"a focal length of 1e\+31 pixels is not between"),
        (first(fx=1e31, w=8, h=6), r"a focal length of 1e\+31 pixels is not between"),
        (first(cx=1e39), "cx is too large for 32 bits"),
        (first(cy=-1e6), r"the principal point 4, -1e\+06 lies more than 100 times the longer"),
        (first(w=8), "w and h belong together"),
        (first(w=8, h=0), "h must be greater than 0"),
        (first(w=0.5, h=6), "w must be at least 1 pixel, got 0.5"),
        (first(w=16, h=8), "correct w and h"),
        (first(w=6, h=8), "EXIF orientation"),
        (first(k1=NAN), "k1 must be a finite number"),
        (first(k1=-1e6), "undistortion leaves nothing of the photograph"),
        (first(k1=0.1, k4=-0.1), r"distortion \(non-zero k4\).*FULL_OPENCV if"),
        (first(camera_model="RADIAL", k6=1), r"non-zero k6\).*with RADIAL"),
        (first(is_fisheye=True, p1=1), r"p1\) is not supported with OPENCV_FISHEYE"),
        (first(camera_model="FOV"), "camera_model 'FOV'.*undistort"),
        # Fields of the whole file.
        (fields(near=0), rf"{TRAIN}: near must be greater than 0"),
        (fields(near=9.0), "near 9 is not less than far 9"),
        (fields(far="9"), "far must be a finite number"),
        (fields(near=1e-30), r"must lie between 1e-12 and 1e\+12"),
        (fields(far=1e30), r"must lie between 1e-12 and 1e\+12"),
        (fields(far=1e39), "too large for 32"),
        (fields(applied_transform=[[1]]), "applied_transform must be a 4x4"),
        (fields(applied_transform=[[0.0] * 4] * 3), "applied_transform flattens space"),
        (fields(applied_scale=0), "applied_scale must be greater than 0"),
        (fields(ply_file_path="none.ply"), r"ply_file_path 'none\.ply' does not exist"),
        (fields(ply_file_path=["a"]), r"ply_file_path \['a'\] does not exist"),
        # Text that is no JSON.
        (put(TRAIN, b'{"frames": [\n}'), "not JSON at line 2"),
        (put(TRAIN, b""), "not JSON at line 1"),
        (put(TRAIN, b"[]"), "not an object"),
        (put(TRAIN, b"{}"), '"frames" must be a list of objects'),
        (put(TRAIN, b'{"frames": "\xff"}'), "not UTF-8"),
        (put(TRAIN, b"[" * 100_000), "nested too deep"),
        (put(TRAIN, b'{"near": ' + b"9" * 5000 + b"}"), "a number has thousands of digits"),
        # Photographs and points.
        (put("train/a.png", b""), r"train/a\.png is not a readable image"),
        (put("train/a.png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(17)), "not a readable image"),
        (edit("train/a.png", lambda data: data.replace(b"IDAT", b"IDAX")), "not a readable image"),
        (ply(10**12, "1234", kind="binary_little_endian"), "before its 1000000000000 vertices do"),
        (terabyte("points3d.ply"), LARGE),
    ],
    masked: [(pipe("m.png"), NOT_ORDINARY)],
    single: [
        (listing(train_filenames="images/000.png"), "train_filenames must be a list"),
        (listing(test_filenames=["000.png"]), r"test_filenames names '000\.png', which is no fr"),
        (listing(val_filenames=["images/000.png", "images/001.png"]), "every frame is held out"),
        (put("masks/000.png", "x"), r"masks/000\.png is not a readable image"),
        (put("masks/000.png", np.eye(3) + 1), r"masks/000\.png: masks hold 2 values from 1 to 2"),
        (put("images/000.png", HEIC), r"images/000\.png is a HEIC photograph, which is not read"),
        (put("masks/000.png", BLACK), "3 x 3 pixels but its photograph is 8 x 6"),
        (put("images/000.mask.png", BLACK), r"images/000\.mask\.png is 3 x 3 pixels"),
        (pipe("masks/000.png"), NOT_ORDINARY),
        (terabyte("masks/000.png"), LARGE),
        (pipe("images/000.png"), "1 of 2 listed images do not exist"),
        (terabyte("images/000.png"), LARGE),
        (pipe("transforms.json"), "holds no capture"),
        (terabyte("transforms.json"), LARGE),
        (endless("transforms.json"), "holds no capture"),
    ],
    colmap: [
        (model(cameras=[]), MISMATCH),
        (model(cameras=["1 FISHY 8 6 10 11 4 3"]), r"cameras\.txt: camera 1 has the unknown.*FIS"),
        (model(cameras=["1 FOV 8 6 10 11 4 3 0.5"]), r"cameras\.txt: camera 1: lens dist.*'FOV'"),
        (model(cameras=["1 PINHOLE 8 6 10 11 4"]), r"\.txt: line 2: PINHOLE needs 4 param.*3"),
        (model(cameras=["1 PINHOLE 8"]), r"cameras\.txt: line 2 ends after 3 fields"),
        (model(cameras=["1 PINHOLE 8 6 -10 11 4 3"]), "camera 1: fx must be greater than 0, got -"),
        (model(cameras=["1 SIMPLE_PINHOLE 8 6 0 4 3"]), "camera 1: f must be greater than 0"),
        (model(cameras=["1 PINHOLE 8 6 nan 11 4 3"]), r"cameras\.txt: line 2 holds .*not finite"),
        (model(cameras=["1 PINHOLE x 6 10 11 4 3"]), r"cameras\.txt: line 2 holds text"),
        (model(cameras=["1 PINHOLE 0 6 10 11 4 3"]), "camera 1: width must be greater than 0"),
        (model(cameras=[PINHOLE.replace("8 6", "6 8")]), "EXIF orientation"),
        (model(cameras=[PINHOLE.replace("8 6", "16 6")]), "8 x 6 pixels, but w and h are 16 x 6"),
        (model(images=[]), r"images\.txt has no image with a pose"),
        (model(images=[image_line(1, "000.png", "nan 0 0 0 0 0 0"), ""]), "000.png.*not finite"),
        (model(images=[image_line(1, "000.png", "1 0 0 0 inf 0 0"), ""]), "000.png.*not finite"),
        (model(images=[image_line(1, "000.png", "0 0 0 0 1 0 0"), ""]), "rotation is 0, 0, 0, 0"),
        (model(images=[image_line(1, "000.png", "x 0 0 0 1 0 0"), ""]), "line 2 holds text"),
        (model(images=[image_line("a", "000.png"), ""]), "line 2 holds text"),
        (model(images=["1 1 0 0 0"]), r"images\.txt: line 2 ends after 5 fields"),
        (model(images=[*IMAGES[:1], "4 3"]), r"images\.txt: line 3 holds 2 numbers"),
        (model(images=[*IMAGES, image_line(3, "001.png"), ""]), r"'001\.png' more than once"),
        (model(images=[image_line(1, "x.png"), "", *IMAGES[2:]]), r"1 of 2 listed .* \(x\.png\)"),
        (model(images=[image_line(1, "000.png", camera=5), ""]), MISMATCH),
        (model(points=["1 nan 0 5 1 2 3 0.5"]), r"points3D\.txt: line 2 holds .*not finite"),
        (model(points=["1 2 0 5 1"]), r"points3D\.txt: line 2 ends after 5 fields"),
        (model(points=["1 0 0 5 1 2 3 0.5 9 9"]), MISMATCH),
        (edit("sparse/0/points3D.txt", without_line(1)), r"shows point \d, which .*points3D\.txt"),
        (remove("sparse/0/points3D.txt"), r"points3D\.txt is missing"),
        (pipe("sparse/0/points3D.txt"), "is missing"),
        (terabyte("sparse/0/points3D.txt"), LARGE),
        (pipe("sparse/0/rigs.txt"), NOT_ORDINARY),
        (remove("images"), "3 of 3 listed images do not exist"),
    ],
    binary: [
        (put("sparse/0/cameras.bin", "# Camera list\n" + f"{PINHOLE}\n" * 3), "has the unknown"),
        (
            edit("sparse/0/cameras.bin", lambda data: data[:12] + b"\x63\0\0\0" + data[16:]),
            r"cameras\.bin: camera 1 has the unknown .* 99",
        ),
        (
            edit("sparse/0/images.bin", lambda d: d[:12] + np.float64(NAN).tobytes() + d[20:]),
            r"images\.bin: image \d \(00\d\.png\): its pose is not",
        ),
        (
            edit("sparse/0/images.bin", lambda data: data.replace(b"001.png", b"00\x99.png")),
            r"images\.bin: image 2 has a name that is not UTF-8",
        ),
        (edit("sparse/0/frames.bin", lambda data: data[:12] + b"\x63" + data[13:]), MISMATCH),
        (frame_quaternion(0.5), "has a pose whose rotation is none"),
        (frame_quaternion(1e39), "has a pose whose rotation is none"),
        (frame_quaternion(1e200), "has a pose whose rotation is none"),
        (
            edit("sparse/0/points3D.bin", fewer_points),
            r"images\.bin: image '00\d\.png' shows point \d, which .*points3D",
        ),
        (remove("sparse/0/cameras.bin"), "holds no capture"),
        (remove("sparse/0/images.bin"), "is missing"),
        (remove("sparse/0/points3D.bin"), "is missing"),
    ],
    llff: [
        (rows(lambda values: values[:, :15]), r"poses_bounds\.npy has shape 3 x 15 instead of N x"),
        (rows(lambda values: values[0]), "has shape 17 instead of N x 17"),
        (rows(lambda values: values[:0]), "has shape 0 x 17 instead of N x 17"),
        (rows(lambda values: values[:2]), r"has 2 poses but .*images has 3 photographs"),
        (put("images/9.png", PIXEL), r"has 3 poses but .*images has 4 photo"),
        (rows(lambda values: values.astype(str)), "instead of real numbers"),
        (rows(lambda values: values.astype(complex)), "holds complex128 values instead of real n"),
        (cell(3, NAN), r"poses_bounds\.npy.*row of 1\.png: pose holds a value .* not finite"),
        (cell(0, 5.0), r"row of 1\.png: pose is not rigid"),
        (cell(14, -9.0), r"1\.png: focal length must be greater than 0"),
        (cell(4, 0.0), r"1\.png: height must be greater than 0"),
        (cell(4, 0.3), "height must be at least 1 pixel"),
        (cell(4, INF), r"row of 1\.png: height must be a finite number, got inf"),
        (cell(4, 16.0), "but w and h are 8 x 16"),
        (cell(15, 99.0), "near bound 99 is not less than far bound 21"),
        (cell(15, -1.0), "near bound must be greater than 0"),
        (put("poses_bounds.npy", b""), NOT_NUMPY),
        (put("poses_bounds.npy", b"hello"), NOT_NUMPY),
        (edit("poses_bounds.npy", lambda data: data[:-9]), NOT_NUMPY),
        (edit("poses_bounds.npy", lambda data: data.replace(b"{'descr'", b"{{'desc(")), NOT_NUMPY),
        (rows(lambda values: np.array([{}], object)), NOT_NUMPY),
        *((array_of(count), NOT_NUMPY) for count in (10**7, 10**12, 2**61, 10**30)),
        (pipe("poses_bounds.npy"), "holds no capture"),
        (terabyte("poses_bounds.npy"), LARGE),
        (pipe("images/0.png"), NOT_ORDINARY),
        (put("split.json", "["), r"split\.json: not JSON at line 1"),
        (put("split.json", b'{"test": ["\xe9.png"]}'), r"split\.json: not UTF-8 text"),
        (put("split.json", "[]"), r"split\.json: not an object with lists"),
        (put("split.json", {"train": "0.png"}), r"split\.json: train must be a list"),
        (put("split.json", {"test": [["0.png"]]}), "test must be a list of the frames' name"),
        (put("split.json", {"test": ["7.png"]}), r"test names '7\.png', which is no frame's name"),
        (put("split.json", {"test": [f"{i}.png" for i in range(3)]}), "out: leave some for train"),
        (terabyte("split.json"), LARGE),
    ],
}


@pytest.mark.parametrize(
    ("make", "change", "words"), [(make, *case) for make, cases in CASES.items() for case in cases]
)
def test_a_wrong_capture_is_refused_in_one_sentence(tmp_path, make, change, words):
    assert str(tmp_path) in refused(tmp_path, make, change, words)


def one(folder):
    single_file(folder, 1)


def same(folder):
    """Change nothing."""


def masks(value):
    pixels = np.full((HEIGHT, WIDTH), value, np.uint8)
    return all_of(put("masks/000.png", pixels), put("masks/001.png", pixels))


def shrunk(*data):
    return all_of(*(put(f"images_2/00{i}.png", one) for i, one in enumerate(data)))


HALF, TALL = np.zeros((3, 4, 3), np.uint8), np.zeros((7, 4, 3), np.uint8)
WHOLE = "must be a whole number of at least"


@pytest.mark.parametrize(
    ("make", "change", "options", "words"),
    [
        *((paper, same, {"downscale": x}, f"downscale {WHOLE} 1") for x in (0, -1, 0.5, True, "2")),
        (paper, same, {"downscale": 7}, "8 x 6 pixels, and downscale 7 leaves nothing"),
        *(
            (paper, same, {"background": x}, r"must be a gray level in \[0, 1\]")
            for x in (-1, 2, NAN)
        ),
        *((llff, same, {"photographs": x}, f"photographs {WHOLE} 2") for x in (1, 2.0)),
        (llff, same, {"photographs": 4}, "has 2 training photographs: ask for fewer than 4"),
        (llff, same, {"photographs": 2, "choose": "best"}, "choose 'best' is unknown: choose one"),
        (llff, same, {"choose": "spread"}, "choose 'spread' needs photographs: say how many"),
        (llff, same, {"format": "nerf"}, "format 'nerf' is unknown: choose one of transforms"),
        (llff, same, {"format": "colmap"}, "holds no capture in the format colmap"),
        (llff, same, {"split": "nearest"}, "split 'nearest' is unknown: choose one of given, eve"),
        (llff, same, {"split": "closest"}, "closest needs points.*--format=colmap.*--split="),
        (single, same, {"zoom": 4}, "zoom needs split 'zoom', but split is 'given': leave out z"),
        *((single, same, {"split": "zoom", "zoom": x}, f"zoom {WHOLE} 2") for x in (1, 2.5, True)),
        (single, same, {"split": "zoom", "downscale": 2}, "downscale 2 times zoom 4 leaves"),
        (single, masks(255), {"invert_masks": True}, "keeps black pixels; leave it out if"),
        (single, masks(0), {}, "white pixels are kept; set invert_masks if"),
        (single, same, {"invert_masks": True}, "no photograph has a mask to invert"),
        (single, same, {"alpha_mode": "mask"}, "no photograph has transparent pixels: leave out a"),
        (llff, same, {"alpha_mode": "x"}, "alpha_mode 'x' is unknown: choose one of blend, mask"),
        (
            single,
            put("images/001.png", CLEAR),
            {"alpha_mode": "mask"},
            "training photographs are fully transparent: .* set alpha_mode to ignore if",
        ),
        (single, put("images/001.png", CLEAR), {}, "training photographs are fully transparent"),
        (single, shrunk(HALF, TALL), {"downscale": 2}, "4 x 7 pixels, which is not 8 x 6"),
        (single, shrunk(HALF, b"x"), {"downscale": 2}, r"images_2/001\.png is not a read"),
        (
            single,
            all_of(pipe("images_2/000.png"), pipe("images_2/001.png")),
            {"downscale": 2},
            NOT_ORDINARY,
        ),
    ],
)
def test_wrong_options_are_refused_in_one_sentence(tmp_path, make, change, options, words):
    refused(tmp_path, make, change, words, **options)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_truncated_binary_models(tmp_path, name):
    binary(tmp_path)
    file = tmp_path / f"sparse/0/{name}.bin"
    data = file.read_bytes()
    for kept in range(0, len(data), 5):
        file.write_bytes(data[:kept])
        with pytest.raises(SceneError, match=rf"{name}\.bin is (truncated in record|empty)"):
            load_scene(tmp_path)
    file.write_bytes(data + b"12345")
    with pytest.raises(SceneError, match=rf"{name}\.bin has 5 bytes after its"):
        load_scene(tmp_path)


def test_no_capture(tmp_path):
    with pytest.raises(SceneError, match=r"holds no capture: add transforms_train\.json, transf"):
        load_scene(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(SceneError, match="is not a folder: give the folder"):
        load_scene(tmp_path / "transforms.json")
    with pytest.raises(SceneError, match="is not a folder"):
        load_scene(tmp_path / "none")


def test_files_without_permission(tmp_path, monkeypatch):
    """Simulate missing permissions, because root may read every file."""
    paper(tmp_path)

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    for owner, name, words in (
        (photo_files, "read_bytes", r"t(rain|est)/.\.png cannot be read \(Permission denied\): r"),
        (pathlib.Path, "read_bytes", rf"{TRAIN} cannot be read \(Permission den"),
        (pathlib.Path, "is_file", r"\.json cannot be read \(Permission denied\): make it"),
    ):
        with monkeypatch.context() as patch, pytest.raises(SceneError, match=words):
            patch.setattr(owner, name, refuse)
            load_scene(tmp_path)


# Input that is unusual, and loads.


@pytest.mark.parametrize(
    ("make", "change", "options", "note"),
    [
        (paper, put("train/a.png", PIXEL), {}, None),
        (single, shrunk(HALF), {"downscale": 2}, "lacks 1 of 2 photographs, such as 001"),
        (one, same, {"split": "zoom"}, "unshrunk, 1 in all"),
    ],
)
def test_unusual_captures_load_without_a_warning(tmp_path, make, change, options, note):
    make(tmp_path)
    change(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(tmp_path, **options)
    assert len(scene.train) in (1, 2)
    assert note is None or note in scene.metadata["notes"][-1]


def test_unknown_fields_warn_once_per_file(tmp_path):
    paper(tmp_path)
    listed = [frame("train/a.png", time=0, sharpness=3), frame("train/b.png", time=1)]
    write_json(tmp_path / TRAIN, listed, aabb_scale=4, color="red")
    with pytest.warns(SceneWarning) as caught:
        load_scene(tmp_path)
    assert [warning.category for warning in caught] == [UnknownKeyWarning]
    words = f"{TRAIN}: these fields are ignored: color, time."
    assert str(caught[0].message).endswith(words)


def copy(name, other):
    return lambda folder: shutil.copy(folder / name, folder / other)


@pytest.mark.parametrize(
    ("make", "change", "category", "words", "count"),
    [
        (
            llff,
            put("split.json", {"train": ["0.png", "1.png"], "test": ["1.png"]}),
            DuplicateFileWarning,
            r"lists 1 photographs more than once: 1\.png \(train and",
            2,
        ),
        (
            llff,
            copy("images/0.png", "images/2.png"),
            DuplicateFileWarning,
            r"1 photographs are the same file as another, such as 2\.png as 0\.png: remove",
            2,
        ),
        (
            llff,
            put("images/1.png", CLEAR),
            BlankPhotographWarning,
            r"fully transparent photographs were left out: 1, such as 1\.png",
            1,
        ),
        (
            paper,
            put("train/a.png", np.full((30, 40, 3), 9)),
            BlankPhotographWarning,
            r"constant photographs show one color everywhere: 1, such as a\.png",
            2,
        ),
        (
            paper,
            ply(3, "1 2 3\n4 5 6\n1e39 0 0\n"),
            PointsWarning,
            "1 of 3 points are not finite",
            2,
        ),
    ],
)
def test_what_looks_like_a_mistake_warns(tmp_path, make, change, category, words, count):
    make(tmp_path)
    change(tmp_path)
    with pytest.warns(category, match=words):
        scene = load_scene(tmp_path)
    assert len(scene.train) == len(scene.names["train"]) == count


@pytest.mark.parametrize("options", [{}, {"split": "zoom", "zoom": 2}])
def test_transparent_photographs_are_in_no_split(tmp_path, options):
    llff(tmp_path)
    for i in range(2):  # the held-out one, and the one whose crop is held out
        put(f"images/{i}.png", CLEAR)(tmp_path)
    with pytest.warns(BlankPhotographWarning, match="left out: 2, such"):
        scene = load_scene(tmp_path, **options)
    assert scene.names == {"train": ["2"]} and scene.test is None and scene.test_far is None
    assert len(load_scene(tmp_path, alpha_mode="ignore", **options).train) == 2
