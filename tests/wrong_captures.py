"""What can be wrong in a capture, by format, and the sentence that says so.

Each sentence is asserted once, damaged files begin with these changes, and the troubles that
`docs/photographs.md` quotes are among them.
"""

import struct
import zlib

import cv2
import numpy as np
from tiny_capture import (
    HEIGHT,
    PINHOLE,
    POSE,
    WIDTH,
    frame,
    image_line,
    single_file,
    tiff,
    write_image,
)
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
    listed,
    llff,
    loop,
    model,
    paper,
    pipe,
    put,
    remove,
    rows,
    single,
    terabyte,
)


NAN, INF, HUGE = float("nan"), float("inf"), 10**400
TURN = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
PIXEL, BLACK = np.zeros((1, 1, 3), np.uint8), np.zeros((3, 3), np.uint8)
CLEAR, WHITE = np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.full((HEIGHT, WIDTH), 255, np.uint8)
HALF, TALL = np.zeros((3, 4, 3), np.uint8), np.zeros((7, 4, 3), np.uint8)
KEPT = np.tile(np.uint8([0, 255]), (HEIGHT, WIDTH // 2))
HIDDEN = np.dstack([KEPT] * 4)  # opaque where it is kept
FIRST = "images/000.png"
NO_MASK = (
    r"masks holds no mask for any of the 2 photographs: for \d+\.png, name the mask \d+\.png\.png, "
    r"\d+\.mask\.png or \d+ with an image"
)
GRAY = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
NOT_ORDINARY, LARGE = "Not an ordinary file", r"More than (64|1024|4096) MiB"
NOT_NUMPY = r"poses_bounds\.npy is truncated or not a NumPy file"
MISMATCH = "do not match each other"
WHOLE = "must be a whole number of at least"


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


def same(folder):
    """Change nothing."""


def masks(value):
    pixels = np.full((HEIGHT, WIDTH), value, np.uint8)
    return all_of(put("masks/000.png", pixels), put("masks/001.png", pixels))


def shrunk(*data):
    return all_of(*(put(f"images_2/00{i}.png", one) for i, one in enumerate(data)))


def alone(folder):
    """Leave one photograph and its row."""
    for i in (1, 2):
        (folder / f"images/{i}.png").unlink()
    rows(lambda values: values[:1])(folder)


def instead(*names):
    """Replace the first photograph by others."""
    return all_of(remove(FIRST), *(lambda folder, n=n: write_image(folder / n) for n in names))


def huge(side):
    """Encode a PNG whose header claims so many pixels on a side."""
    data = cv2.imencode(".png", BLACK)[1].tobytes()
    header = b"IHDR" + struct.pack(">II", side, side) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


# Files in a photograph's place.
NOT_READ = [
    ("hello", "is not a readable image"),
    (cv2.imencode(".tiff", np.zeros((4, 4, 3), np.float32))[1].tobytes(), "holds float32 values"),
    (huge(100_000), "has more than 170 megapixels"),
    (HEIC, "is a HEIC photograph, which is not read: export it as JPEG"),
    (b"\x76\x2f\x31\x01" + bytes(99), "is an OpenEXR image, .*: export it as PNG"),
    (b"\xff\x0a" + bytes(99), "is a JPEG XL image"),
    (b"\0\0\0\x0cJXL \r\n\x87\n" + bytes(99), "is a JPEG XL image"),
    (b"\0\0\0\x18ftypcrx " + bytes(99), "is a camera's raw file, .*: develop it and"),
    (b"II*\0\x10\0\0\0CR\x02\0" + bytes(99), "is a camera's raw file"),
    (tiff(GRAY, "<", 1, (50706, 1)), "is a camera's raw file"),
    (tiff(GRAY, ">", 1, (254, 1), (330, 8)), "is a camera's raw file"),
    (tiff(np.repeat(GRAY, 4, -1), "<", 1, (262, 5)), "is a TIFF of CMYK colors.*: export it"),
]

XYZ = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    "property float z\n{}end_header\n"
)
# Texts in the place of a PLY file of points.
NO_POINTS = [
    ("", "is not a PLY file"),
    ("hello\nend_header\n", "is not a PLY file"),
    ("ply\nformat gzip 1.0\nend_header\n", "is not a PLY file"),
    ("ply\nformat ascii 1.0\nelement face 1\nend_header\n", "does not begin with vertices"),
    ("ply\nformat ascii 1.0\nend_header\n", "does not begin with vertices"),
    (
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        "plain properties x, y, z",
    ),
    (
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n",
        "plain properties x, y, z",
    ),
    (XYZ.format(-1, ""), "a count of -1"),
    (XYZ.format(1, "property float x\n") + "1 2 3 4\n", "a property name appears twice"),
    (XYZ.format(1, "") + "a b c\n", "has words instead of numbers"),
    *(
        (XYZ.format(count, "") + "1 2 3\n", f"ends before its {count} vertices do")
        for count in (2, 10**12, 10**30)
    ),
    *(
        (XYZ.format(1, "property uchar red\n") + f"1 2 3 {red}\n", "numbers beyond their type")
        for red in ("300", "inf", "nan")
    ),
]

# By format: a change, a pattern of the sentence, and options of `load_scene` if there are any.
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
        (first(mask_path="m/m.png"), r"a\.png': its mask .*m\.png does not exist \(1 of 1 masks"),
        (all_of(first(mask_path="m.png"), pipe("m.png")), NOT_ORDINARY),
        (put("masks/a.png", WHITE), r"masks/a\.png matches both .*train/a\.png and .*test/a"),
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
        (remove("train/a.png"), "1 of 2 listed images do not"),
        (put("train/a.png", b""), r"train/a\.png is not a readable image"),
        (put("train/a.png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(17)), "not a readable image"),
        (edit("train/a.png", lambda data: data.replace(b"IDAT", b"IDAX")), "not a readable image"),
        *((put("points3d.ply", text), words) for text, words in NO_POINTS),
        (ply(10**12, "1234", kind="binary_little_endian"), "before its 1000000000000 vertices do"),
        (terabyte("points3d.ply"), LARGE),
        # Options.
        *((same, f"downscale {WHOLE} 1", {"downscale": x}) for x in (0, -1, 0.5, True, "2")),
        (same, "8 x 6 pixels, and downscale 7 leaves nothing", {"downscale": 7}),
        *((same, r"must be a gray level in \[0, 1\]", {"background": x}) for x in (-1, 2, NAN)),
    ],
    single: [
        (listing(train_filenames="images/000.png"), "train_filenames must be a list"),
        (listing(test_filenames=["000.png"]), r"test_filenames names '000\.png', which is no fr"),
        (listing(val_filenames=["images/000.png", "images/001.png"]), "every frame is held out"),
        (put("masks/000.png", "x"), r"masks/000\.png is not a readable image"),
        (put("masks/000.png", np.eye(3) + 1), r"masks/000\.png: masks hold 2 values from 1 to 2"),
        *((put(FIRST, data), rf"images/000\.png {words}") for data, words in NOT_READ),
        (put("masks/000.png", BLACK), "3 x 3 pixels but its photograph is 8 x 6"),
        (put("images/000.mask.png", BLACK), r"images/000\.mask\.png is 3 x 3 pixels"),
        (put("masks/mask_001.png", WHITE), NO_MASK),
        (lambda folder: (folder / "masks").mkdir(), NO_MASK),
        (pipe("masks/000.png"), NOT_ORDINARY),
        (terabyte("masks/000.png"), LARGE),
        (pipe("images/000.png"), "1 of 2 listed images do not exist"),
        (terabyte("images/000.png"), LARGE),
        (pipe("transforms.json"), "holds no capture"),
        (terabyte("transforms.json"), LARGE),
        (endless("transforms.json"), "holds no capture"),
        # Photographs under other names.
        (remove(FIRST), r"1 of 2 listed images do not exist .*images/000\.png\), nor in another"),
        # Another's photograph and a mask are not the missing one.
        (listed(FIRST, "images/sub/001.png"), r"1 of 2 .*\(images/sub/001\.png\)"),
        (instead("images/000.png.png", "images/000.mask.png"), r"1 of 2 .*\(images/000\.png\)"),
        (instead("images/000.jpg", "images/000.bmp"), r"fits both .*000\.bmp and .*000\.jpg: rem"),
        (
            instead("images/000.PNG", "Images/000.png"),
            r"both .*Images/000\.png and .*images/000\.P",
        ),
        # Options.
        (same, "zoom needs split 'zoom', but split is 'given': leave out z", {"zoom": 4}),
        *((same, f"zoom {WHOLE} 2", {"split": "zoom", "zoom": x}) for x in (1, 2.5, True)),
        (same, "downscale 2 times zoom 4 leaves", {"split": "zoom", "downscale": 2}),
        (masks(255), "keeps black pixels; leave it out if", {"invert_masks": True}),
        (masks(0), "white pixels are kept; set invert_masks if"),
        (same, "no photograph has a mask to invert", {"invert_masks": True}),
        (same, "no photograph has transparent pixels: leave out a", {"alpha_mode": "mask"}),
        (put("images/001.png", CLEAR), "training photographs are fully transparent"),
        (
            put("images/001.png", CLEAR),
            "fully transparent: .* set alpha_mode to ignore if",
            {"alpha_mode": "mask"},
        ),
        (
            all_of(
                *(put(f"{of}/001.png", x) for of, x in (("images", HIDDEN), ("masks", 255 - KEPT)))
            ),
            "masks leave no pixel",
            {"alpha_mode": "mask"},
        ),
        (shrunk(HALF, TALL), "4 x 7 pixels, which is not 8 x 6", {"downscale": 2}),
        (shrunk(HALF, b"x"), r"images_2/001\.png is not a read", {"downscale": 2}),
        (
            all_of(pipe("images_2/000.png"), pipe("images_2/001.png")),
            NOT_ORDINARY,
            {"downscale": 2},
        ),
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
        (loop("images/0.png"), r"images/0\.png cannot be read \(Too many levels of symbolic"),
        (put("split.json", "["), r"split\.json: not JSON at line 1"),
        (put("split.json", b'{"test": ["\xe9.png"]}'), r"split\.json: not UTF-8 text"),
        (put("split.json", "[]"), r"split\.json: not an object with lists"),
        (put("split.json", {"train": "0.png"}), r"split\.json: train must be a list"),
        (put("split.json", {"test": [["0.png"]]}), "test must be a list of the frames' name"),
        (put("split.json", {"test": ["7.png"]}), r"test names '7\.png', which is no frame's name"),
        (put("split.json", {"test": [f"{i}.png" for i in range(3)]}), "out: leave some for train"),
        (terabyte("split.json"), LARGE),
        # Options.
        *((same, f"photographs {WHOLE} 2", {"photographs": x}) for x in (1, 2.0)),
        (same, "has 2 training photographs: ask for fewer than 4", {"photographs": 4}),
        (same, "choose 'best' is unknown: choose one", {"photographs": 2, "choose": "best"}),
        (same, "choose 'spread' needs photographs: say how many", {"choose": "spread"}),
        (same, "format 'nerf' is unknown: choose one of transforms", {"format": "nerf"}),
        (same, "holds no capture in the format colmap", {"format": "colmap"}),
        (same, "split 'nearest' is unknown: choose one of given", {"split": "nearest"}),
        (same, "closest needs points.*--format=colmap.*--split=", {"split": "closest"}),
        (same, "alpha_mode 'x' is unknown: choose one of blend, mask", {"alpha_mode": "x"}),
        (alone, "closest needs at least 2 photographs", {"split": "closest"}),
    ],
}
