"""Files of a capture that are no ordinary ones, or that claim more than they hold."""

import os
import signal

import numpy as np
import pytest
from tiny_capture import colmap_capture, frame, llff_capture, paper_capture, single_file, write_json

from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.io.files import check_file, read_bytes
from jaxcloseup.photos.scene import PointsWarning


@pytest.fixture(autouse=True)
def soon():
    """Reading a pipe never ends."""

    def stop(*_):
        raise TimeoutError("still reading")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pipe(path):
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)


def terabyte(path):
    """A sparse file, which takes no room on disk."""
    path.parent.mkdir(exist_ok=True)
    path.touch()
    os.truncate(path, 2**40)


def two(folder):
    single_file(folder, 2)


def with_mask(folder):
    paper_capture(folder)
    frames = [frame("train/a.png", mask_path="m.png"), frame("train/b.png")]
    write_json(folder / "transforms_train.json", frames)


PIPE, LARGE = "Not an ordinary file", r"More than (64|1024|4096) MiB"


@pytest.mark.parametrize(
    ("make", "name", "damage", "message"),
    [
        (with_mask, "m.png", pipe, PIPE),
        (two, "masks/000.png", pipe, PIPE),
        (two, "masks/000.png", terabyte, LARGE),
        (two, "images/000.png", pipe, "1 of 2 listed images do not exist"),
        (two, "images/000.png", terabyte, LARGE),
        (two, "transforms.json", pipe, "holds no capture"),
        (two, "transforms.json", terabyte, LARGE),
        (paper_capture, "points3d.ply", terabyte, LARGE),
        (llff_capture, "images/0.png", pipe, PIPE),
        (llff_capture, "split.json", terabyte, LARGE),
        (llff_capture, "poses_bounds.npy", pipe, "holds no capture"),
        (llff_capture, "poses_bounds.npy", terabyte, LARGE),
        (colmap_capture, "sparse/0/points3D.txt", pipe, "is missing"),
        (colmap_capture, "sparse/0/points3D.txt", terabyte, LARGE),
        (colmap_capture, "sparse/0/rigs.txt", pipe, PIPE),
    ],
)
def test_pipes_and_endless_files_are_refused(tmp_path, make, name, damage, message):
    make(tmp_path)
    if (tmp_path / "sparse").is_dir():
        pytest.importorskip("pycolmap")
    damage(tmp_path / name)
    with pytest.raises(SceneError, match=message) as error:
        load_scene(tmp_path)
    assert "\n" not in str(error.value)


def test_shrunk_photographs_that_are_pipes_are_refused(tmp_path):
    two(tmp_path)
    for name in ("000", "001"):
        pipe(tmp_path / f"images_2/{name}.png")
    with pytest.raises(SceneError, match=PIPE):
        load_scene(tmp_path, downscale=2)


def test_devices_folders_and_large_files(tmp_path):
    with pytest.raises(OSError, match=PIPE):
        read_bytes("/dev/zero")
    with pytest.raises(IsADirectoryError, match="Is a directory"):
        check_file(tmp_path)
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", most=5) == b"12345"
    with pytest.raises(OSError, match=r"More than 3\.8147e-06 MiB"):
        read_bytes(tmp_path / "a", most=4)


@pytest.mark.parametrize("rows", [10**7, 10**12, 2**61, 10**30])
def test_an_array_that_claims_more_rows_than_the_file_holds(tmp_path, rows):
    llff_capture(tmp_path)
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({rows}, 17), }}\n".encode()
    data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(17 * 8)
    (tmp_path / "poses_bounds.npy").write_bytes(data)
    with pytest.raises(SceneError, match=r"poses_bounds\.npy is truncated or not a NumPy file"):
        load_scene(tmp_path)


def test_a_damaged_header_of_an_array(tmp_path):
    llff_capture(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(path.read_bytes().replace(b"{'descr'", b"{{'desc("))
    with pytest.raises(SceneError, match=r"poses_bounds\.npy is truncated or not a NumPy file"):
        load_scene(tmp_path)
    np.save(path, np.zeros((0, 17)))
    with pytest.raises(SceneError, match=r"poses_bounds\.npy"):
        load_scene(tmp_path)


@pytest.mark.parametrize("count", [3, 10**12, 10**30])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_points_that_claim_more_than_the_file_holds(tmp_path, count, encoding):
    paper_capture(tmp_path)
    header = f"ply\nformat {encoding} 1.0\nelement vertex {count}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "points3d.ply").write_text(header + "1 2 3\n4 5 6\n")
    with pytest.raises(SceneError, match=f"ends before its {count} vertices do"):
        load_scene(tmp_path)


def test_numbers_of_points_beyond_their_type(tmp_path):
    paper_capture(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    header += "property float z\nproperty uchar red\nend_header\n"
    for red in ("300", "inf", "nan"):
        (tmp_path / "points3d.ply").write_text(f"{header}1 2 3 {red}\n")
        with pytest.raises(SceneError, match="numbers beyond their type: export it again"):
            load_scene(tmp_path)


@pytest.mark.parametrize("binary", [False, True])
def test_observations_of_points_that_the_model_lacks(tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap")
    colmap_capture(tmp_path)
    model = tmp_path / "sparse/0"
    if binary:
        found = pycolmap.Reconstruction()
        found.read_text(str(model))
        found.write_binary(str(model))
        data = (model / "points3D.bin").read_bytes()
        size = (len(data) - 8) // 5  # five points with equal tracks
        (model / "points3D.bin").write_bytes((4).to_bytes(8, "little") + data[8 : 8 + 4 * size])
    else:
        lines = (model / "points3D.txt").read_text().splitlines()
        (model / "points3D.txt").write_text("\n".join([lines[0], *lines[2:]]))
    with pytest.raises(
        SceneError, match=r"images\.(bin|txt): image '00\d\.png' shows point \d, which .*points3D"
    ):
        load_scene(tmp_path)


def test_a_photograph_whose_name_is_no_text(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    colmap_capture(tmp_path)
    model = tmp_path / "sparse/0"
    found = pycolmap.Reconstruction()
    found.read_text(str(model))
    found.write_binary(str(model))
    path = model / "images.bin"
    path.write_bytes(path.read_bytes().replace(b"001.png", b"00\x99.png"))
    with pytest.raises(SceneError, match=r"images\.bin: image 2 has a name that is not UTF-8"):
        load_scene(tmp_path)


@pytest.mark.parametrize("factor", [0.5, 1e39, 1e200])
def test_a_frame_whose_quaternion_has_another_length(tmp_path, factor):
    """pycolmap normalizes the quaternions of images alone."""
    pycolmap = pytest.importorskip("pycolmap")
    colmap_capture(tmp_path)
    model = tmp_path / "sparse/0"
    found = pycolmap.Reconstruction()
    found.read_text(str(model))
    found.write_binary(str(model))
    path = model / "frames.bin"
    data = path.read_bytes()
    path.write_bytes(
        data.replace(
            np.float64([1, 0, 0, 0]).tobytes(), np.float64([factor, factor, 0, 0]).tobytes()
        )
    )
    assert path.read_bytes() != data
    with pytest.raises(SceneError, match="has a pose whose rotation is none"):
        load_scene(tmp_path)


def test_points_beyond_their_type_are_dropped(tmp_path):
    paper_capture(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 3\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "points3d.ply").write_text(header + "1 2 3\n4 5 6\n1e39 0 0\n")
    with pytest.warns(PointsWarning, match="1 of 3 points are not finite"):
        assert len(load_scene(tmp_path).points) == 2
