"""A harness for wrong input: good captures of every format, changes to them, and a check.

A change is a function of the capture's folder. `refused` makes a capture, changes it, loads it and
checks the sentence that the user reads.
"""

import json
import os
import pathlib
import shutil
import signal

import numpy as np
import pytest
from tiny_capture import (
    colmap_capture,
    frame,
    image_line,
    llff_capture,
    llff_rows,
    paper_capture,
    single_file,
    write_image,
    write_json,
    write_model,
)

from jaxcloseup.captures.load import SceneError, load_scene


HEIC = b"\0\0\0\x24ftypheic\0\0\0\0mif1MiHEheic" + bytes(200)  # how such a file begins


# Good captures: each function writes one into a folder.

paper, colmap, llff = paper_capture, colmap_capture, llff_capture
TRAIN = "transforms_train.json"
IMAGES = [image_line(1, "000.png"), "", image_line(2, "001.png"), ""]


def single(folder):
    single_file(folder, 2)


def binary(folder):
    """A binary COLMAP model, with rigs and frames."""
    pycolmap = pytest.importorskip("pycolmap")
    model = colmap(folder) / "sparse/0"
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(model))
    for file in model.glob("*.txt"):
        file.unlink()
    reconstruction.write_binary(str(model))


# Changes to any file.


def put(name, data):
    """Write bytes, text, JSON, or pixels."""

    def change(folder):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(data, np.ndarray):
            write_image(path, data)
        elif isinstance(data, bytes):
            path.write_bytes(data)
        else:
            path.write_text(data if isinstance(data, str) else json.dumps(data))

    return change


def edit(name, function):
    """Replace the bytes of a file by a function of them that changes them."""

    def change(folder):
        before = (folder / name).read_bytes()
        after = function(before)
        assert after != before
        (folder / name).write_bytes(after)

    return change


def remove(name):
    def change(folder):
        path = folder / name
        path.unlink() if path.is_file() else shutil.rmtree(path)

    return change


def pipe(name):
    """Put a pipe in the file's place: reading it never ends."""

    def change(folder):
        path = folder / name
        path.unlink(missing_ok=True)
        path.parent.mkdir(exist_ok=True)
        os.mkfifo(path)

    return change


def terabyte(name):
    """Make the file as large, but sparse: it takes no room on disk."""

    def change(folder):
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.truncate(path, 2**40)

    return change


def link(name, target):
    def change(folder):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(target)

    return change


def endless(name):
    return link(name, "/dev/zero")


def loop(name):
    return link(name, pathlib.PurePath(name).name)


# Changes to one format.


def listed(before, after):
    """Change what the files of either format list."""

    def change(folder):
        file = next(
            name for name in ("transforms.json", "sparse/0/images.txt") if (folder / name).exists()
        )
        edit(file, lambda data: data.replace(before.encode(), after.encode()))(folder)

    return change


def frames(*listed, **fields):
    """Write the training frames of the paper's layout."""
    return lambda folder: write_json(folder / TRAIN, list(listed), **fields)


def first(*, without=(), **changes):
    """Change fields of the first training frame, or leave some out."""
    wrong = {k: v for k, v in frame("train/a.png", **changes).items() if k not in without}
    return frames(wrong, frame("train/b.png"))


def fields(**changes):
    return frames(frame("train/a.png"), **changes)


def model(**changes):
    """Write a text model of two images and no points, with other lines."""
    lines = {"images": IMAGES, "points": (), **changes}
    return lambda folder: write_model(folder / "sparse/0", **lines)


def rows(function):
    """Change the rows of LLFF's file."""

    def change(folder):
        values = function(llff_rows(3)[0])
        np.save(folder / "poses_bounds.npy", values, allow_pickle=True)

    return change


def cell(column, value):
    """Change a number of the second row."""

    def function(values):
        values[1, column] = value
        return values

    return rows(function)


def all_of(*changes):
    def change(folder):
        for one in changes:
            one(folder)

    return change


# The check.


def refused(folder, make, change, words, **options):
    """Check that loading a changed capture raises one short sentence that has these words."""
    make(folder)
    if (folder / "sparse").is_dir():
        pytest.importorskip("pycolmap")
    change(folder)
    with pytest.raises(SceneError, match=words) as error:
        load_scene(folder, **options)
    text = str(error.value)
    assert text.isprintable() and len(text) < 600
    return text


@pytest.fixture
def soon():
    """Fail a test that waits, for example for a pipe."""

    def stop(*_):
        raise TimeoutError("still reading")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
