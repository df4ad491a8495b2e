"""Read damaged files in a process of its own, one after the other.

    python tests/fuzzing.py FOLDER RUN      # then numbers of mutations on its input

A number decides what is damaged and how, so a fault is found again by its number. RUN is a run of
surfels. An outcome is good if a reader returns finite, sane arrays, or raises an error of this
project whose message is one printable sentence.
"""

import contextlib
import json
import os
import pathlib
import random
import resource
import shutil
import sys
import time
import traceback
import warnings

import cv2
import jax
import numpy as np
from mutations import mutate
from tiny_capture import (
    colmap_capture,
    frame,
    llff_capture,
    paper_capture,
    single_file,
    vertices,
    write_image,
    write_json,
    write_ply,
)

from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.setup import state_shapes
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, read_run
from jaxcloseup.app.view.camera_files import read_camera_path, read_camera_transform
from jaxcloseup.app.view.camera_paths import CameraError
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.captures.photo_files import read_image, read_mask
from jaxcloseup.io.ply import PlyError, read_vertices
from jaxcloseup.io.torch_file import TorchFileError, read_tensors


DATA = pathlib.Path(__file__).parent / "data"
ERRORS = (SceneError, RunError, CheckpointError, CameraError, PlyError, TorchFileError)
LARGEST = 2**31  # bytes that reading may take
LOAD_OPTIONS = [
    *({}, {}, {"split": "every8"}, {"split": "closest"}, {"split": "zoom", "zoom": 2}),
    *({"downscale": 2}, {"invert_masks": True}, {"alpha_mode": "mask"}, {"half_pixel": True}),
]


class Insane(Exception):
    """A reader returned what nothing can be made of."""


def check(holds, what):
    if not holds:
        raise Insane(what)


def check_views(views):
    pose, lens = (np.asarray(a) for a in (views.cameras.camtoworld, views.cameras.intrinsics))
    check(np.isfinite(pose).all() and np.isfinite(lens).all(), "cameras that are not finite")
    turned = np.einsum("vji,vjk->vik", pose[..., :3], pose[..., :3])
    check(np.abs(turned - np.eye(3)).max() < 0.01, "cameras that are not rotations")
    check((lens[:, :2] > 0).all(), "a focal length that is not positive")
    rgb, weight = np.asarray(views.rgb), np.asarray(views.weight)
    check(rgb.shape == (*weight.shape, 3) and len(rgb) == len(pose) > 0, "shapes that do not match")
    scale = 255 if weight.dtype == np.uint8 else 1
    check(np.isfinite(weight).all() and weight.min() >= 0 and weight.max() <= scale, "weights")
    check(rgb.dtype == np.uint8 or (rgb.min() >= 0 and rgb.max() <= 1), "colors")


def check_scene(scene):
    check(0 < scene.near < scene.far < np.inf, f"depth {scene.near} to {scene.far}")
    check(np.isfinite(scene.points).all() and np.isfinite(scene.rgb).all(), "points or colors")
    check(scene.points.shape == scene.rgb.shape, "points and colors that do not match")
    for views in (scene.train, scene.test, scene.test_far):
        if views is not None:
            check_views(views)
    for name in (name for names in scene.names.values() for name in names):
        check(name.isprintable(), f"a name that cannot be printed: {name!r}")
    check(all(note.isprintable() for note in scene.metadata["notes"]), "notes")


def read_capture(rng, folder):
    check_scene(load_scene(folder, **rng.choice(LOAD_OPTIONS)))


def read_pictures(rng, folder):
    for path in sorted(folder.iterdir()):
        image = read_image(path) if rng.random() < 0.7 else read_mask(path)
        check(image.dtype == np.uint8 and image.ndim in (2, 3) and image.size, "an image")


def read_points(rng, folder):
    for path in sorted(folder.iterdir()):
        check(read_vertices(path).dtype.names is not None, "vertices")


def read_weights(rng, folder):
    for path in sorted(folder.iterdir()):
        for array in read_tensors(path).values():
            check(array.dtype.kind in "fiu" and array.nbytes < 10**6, "a tensor")


def read_paths(rng, folder):
    transform, scale = read_camera_transform(folder / "dataparser_transforms.json")
    check(np.isfinite(transform).all() and 0 < scale < np.inf, "a transform")
    cameras = read_camera_path(folder / "camera_path.json").cameras
    for array in (cameras.camtoworld, cameras.intrinsics):
        check(np.isfinite(np.asarray(array)).all(), "cameras that are not finite")


class Reader:
    """Reads runs; holds what an intact one is restored to."""

    def __init__(self, run):
        self.run = run
        record = read_run(run)
        self.preset, scene = record.preset, load_run_scene(record)
        shapes = state_shapes(Programs(record.preset, scene))
        self.like = jax.tree.map(lambda leaf: jax.numpy.zeros(leaf.shape, leaf.dtype), shapes)

    def copy(self, folder):
        shutil.copytree(self.run, folder, dirs_exist_ok=True)
        log = TrainLog(folder)
        log.begin("baseline", [{"step": 1, "loss": 0.5, "skipped": 0}])

    def read(self, rng, folder):
        TrainLog(folder).begin("baseline", [{"step": 1, "loss": 0.5, "skipped": 0}])
        record = read_run(folder)
        check_scene(load_run_scene(record))
        if record.preset == self.preset:
            found = Checkpoints(folder / "checkpoints", record.identity).load("closeup", self.like)
            for leaf in jax.tree.leaves(found[1] if found else ()):
                is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
                check(is_key or np.isfinite(np.asarray(leaf)).all(), "a state")


def make_paper(folder):
    paper_capture(folder)
    frames = [frame("train/a.png", mask_path="m.png"), frame("train/b.png")]
    write_json(folder / "transforms_train.json", frames, ply_file_path="points3d.ply")
    write_image(folder / "m.png", np.full((6, 8), 255, np.uint8))
    write_ply(folder / "points3d.ply", vertices(count=9))


def make_single(folder):
    single_file(folder, 9, applied_transform=np.eye(3, 4).tolist(), k2=0.01, p1=0.001)
    clear = np.full((6, 8, 4), 200, np.uint8)
    clear[0] = 0
    write_image(folder / "images/001.png", clear)
    for i in range(9):
        write_image(folder / f"masks/{i:03d}.png", np.tile(np.uint8([0, 255]), (6, 4)))
    lists = {"train": [f"{i:03d}.png" for i in range(6)], "test": ["006.png", "007.png"]}
    (folder / "split.json").write_text(json.dumps(lists))


def make_llff(folder):
    llff_capture(folder)
    write_ply(folder / "points3d.ply", vertices(), "ascii")


def make_binary_model(folder):
    import pycolmap

    colmap_capture(folder)
    model = pycolmap.Reconstruction()
    model.read_text(str(folder / "sparse/0"))
    model.write_binary(str(folder / "sparse/0"))
    for path in (folder / "sparse/0").glob("*.txt"):
        path.unlink()


def make_pictures(folder):
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 4), np.uint8)
    write_image(folder / "a.jpg", picture[..., :3])
    write_image(folder / "b.png", picture)
    write_image(folder / "c.png", picture[..., 0])
    picture = np.clip(picture[..., :3].astype(np.uint16) * 257, 0, 65535)
    (folder / "d.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def make_points(folder):
    for name in ("ascii", "binary_little_endian", "binary_big_endian"):
        write_ply(folder / f"{name}.ply", vertices(), name)


def make_weights(folder):
    for name in ("tensors_zip.pth", "tensors_legacy.pth"):
        shutil.copy(DATA / name, folder)


def make_paths(folder):
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    cameras = [{"camera_to_world": pose.ravel().tolist(), "fov": 50, "aspect": 1.5}] * 3
    path = {"camera_type": "perspective", "render_height": 60, "render_width": 90, "fps": 24}
    text = json.dumps({**path, "seconds": 2, "default_fov": 40, "camera_path": cameras})
    (folder / "camera_path.json").write_text(text)
    transform = {"transform": np.eye(3, 4).tolist(), "scale": 0.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(transform))


def make_cached(folder):
    """A capture whose cache of shrunk photographs is in `cache`; the rest is not damaged."""
    single_file(folder / "capture", 2)
    with kept_in(folder / "cache"):
        load_scene(folder / "capture", downscale=2)


def read_cached(rng, folder):
    with kept_in(folder / "cache"):
        check_scene(load_scene(folder / "capture", downscale=2))


@contextlib.contextmanager
def kept_in(folder):
    before = os.environ["XDG_CACHE_HOME"]
    os.environ["XDG_CACHE_HOME"] = str(folder)
    try:
        yield
    finally:
        os.environ["XDG_CACHE_HOME"] = before


def cases(run):
    """What is read: functions that make a folder and read it, and the names to damage in it."""
    reader = Reader(run)
    return {
        "transforms": (make_paper, read_capture, "*"),
        "fields": (make_single, read_capture, "*.json"),
        "files": (make_single, read_capture, "*"),
        "colmap text": (colmap_capture, read_capture, "*.txt"),
        "colmap binary": (make_binary_model, read_capture, "*.bin"),
        "llff": (make_llff, read_capture, "*.npy"),
        "capture of llff": (make_llff, read_capture, "*"),
        "pictures": (make_pictures, read_pictures, "*"),
        "points": (make_points, read_points, "*"),
        "weights": (make_weights, read_weights, "*"),
        "camera paths": (make_paths, read_paths, "*"),
        "cache": (make_cached, read_cached, "*.photo"),
        "run": (reader.copy, reader.read, "*"),
        "fields of a run": (reader.copy, reader.read, "*.json*"),
    }


def one(rng, make, read, only, folder):
    """Read a damaged folder.

    Returns:
      What was damaged; whether a reader refused it; and what is wrong with the outcome, or None.
    """
    folder.mkdir()
    make(folder)
    what = mutate(rng, folder, only)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)  # of NumPy: numbers overflow in silence
            read(rng, folder)
    except ERRORS as error:
        text = str(error)
        sentence = text.isprintable() and 20 < len(text) < 1000
        return what, True, None if sentence else f"says {text[:300]!r}"
    except OSError as error:  # of logs, which say it in a sentence
        if error.errno is not None or "\n" in str(error):
            return what, True, traceback.format_exc()
        return what, True, None
    except Exception:
        return what, True, traceback.format_exc()
    return what, False, None


def main():
    """Answer each number with a line of JSON."""
    folder, run = map(pathlib.Path, sys.argv[1:])
    answers = os.fdopen(os.dup(1), "w")
    silent = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):  # C++ prints there too
        os.dup2(silent, number)
    os.environ["XDG_CACHE_HOME"] = str(folder / "no cache")
    made = cases(run)
    used = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + LARGEST, used + LARGEST))
    answers.write("ready\n")
    answers.flush()
    for number in map(int, sys.stdin):
        rng, start = random.Random(number), time.process_time()
        name = sorted(made)[number % len(made)]
        place = folder / f"read {number}"
        what, refused, fault = one(rng, *made[name], place)
        shutil.rmtree(place, ignore_errors=True)
        seconds = time.process_time() - start
        answer = {"case": name, "what": what, "refused": refused, "fault": fault}
        answer["seconds"] = seconds
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
