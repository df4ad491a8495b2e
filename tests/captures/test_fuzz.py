"""Damaged files of all kinds: a reader says one sentence, or returns what can be used.

The files are read in a process of its own, which a crash may take down, as

    python tests/captures/test_fuzz.py FOLDER RUN      # then numbers of mutations on its input

A number decides what is damaged and how, so a fault is found again by its number. Some captures
are wrong before they are damaged. RUN is a run of surfels. `JAXCLOSEUP_FUZZ=5000` reads so many
files instead of the usual number, and `JAXCLOSEUP_FUZZ=17:18` the seventeenth again.
"""

import collections
import contextlib
import json
import os
import pathlib
import random
import resource
import selectors
import shutil
import subprocess
import sys
import time
import traceback
import warnings

import jax
import numpy as np
import pytest
from mutations import mutate
from tiny_capture import frame, single_file, vertices, write_image, write_json, write_ply
from wrong_captures import CASES
from wrong_input import binary, colmap, llff, paper, single

from jaxcloseup.app.run.logs import TrainLog
from jaxcloseup.app.run.programs import Programs
from jaxcloseup.app.run.states import state_shapes
from jaxcloseup.app.store.stored_run import RunError, load_run_scene, read_run
from jaxcloseup.app.view.camera_files import read_camera_path, read_camera_transform
from jaxcloseup.app.view.camera_paths import CameraError
from jaxcloseup.artifacts.checkpoints import CheckpointError, Checkpoints
from jaxcloseup.captures.load import SceneError, load_scene
from jaxcloseup.captures.mask_values import read_mask
from jaxcloseup.captures.photo_files import read_image
from jaxcloseup.io.ply import PlyError, read_vertices
from jaxcloseup.io.torch_file import TorchFileError, read_tensors


MUTATIONS = 300
WRONG = 0.25  # of the captures are so before they are damaged
HANG = 10  # seconds of a computer that does nothing else
PATIENCE = 3  # times as long on a busy one
LARGEST = 2**31  # bytes that reading may take
TESTS = pathlib.Path(__file__).parents[1]
ERRORS = (SceneError, RunError, CheckpointError, CameraError, PlyError, TorchFileError)
LOAD_OPTIONS = [
    *({}, {}, {"split": "every8"}, {"split": "closest"}, {"split": "zoom", "zoom": 2}),
    *(
        {"downscale": 2},
        {"invert_masks": True},
        {"alpha_mode": "mask"},
        {"alpha_mode": "ignore"},
        {"half_pixel": True},
    ),
]


# What a reader may return.


class Insane(Exception):
    """A reader returned what nothing can be made of."""


def check(holds, what):
    if not holds:
        raise Insane(what)


def check_finite(what, *arrays):
    check(all(np.isfinite(np.asarray(array)).all() for array in arrays), f"{what} not finite")


def check_views(views):
    pose, lens = (np.asarray(a) for a in (views.cameras.camtoworld, views.cameras.intrinsics))
    check_finite("cameras", pose, lens)
    turned = np.einsum("vji,vjk->vik", pose[..., :3], pose[..., :3])
    check(np.abs(turned - np.eye(3)).max() < 0.01, "cameras that are not rotations")
    check((lens[:, :2] > 0).all(), "a focal length that is not positive")
    rgb, weight = np.asarray(views.rgb), np.asarray(views.weight)
    check(rgb.shape == (*weight.shape, 3) and len(rgb) == len(pose) > 0, "shapes that do not match")
    scale = 255 if weight.dtype == np.uint8 else 1
    check_finite("weights", weight)
    check(weight.min() >= 0 and weight.max() <= scale, "weights")
    check(rgb.dtype == np.uint8 or (rgb.min() >= 0 and rgb.max() <= 1), "colors")


def check_scene(scene):
    check(0 < scene.near < scene.far < np.inf, f"depth {scene.near} to {scene.far}")
    check_finite("points or colors", scene.points, scene.rgb)
    check(scene.points.shape == scene.rgb.shape, "points and colors that do not match")
    for views in (scene.train, scene.test, scene.test_far):
        if views is not None:
            check_views(views)
    for name in (name for names in scene.names.values() for name in names):
        check(name.isprintable(), f"a name that cannot be printed: {name!r}")
    check(all(note.isprintable() for note in scene.metadata["notes"]), "notes")


# Intact folders, and readers of damaged ones.


def make_paper(folder):
    paper(folder)
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
    llff(folder)
    write_ply(folder / "points3d.ply", vertices(), "ascii")


def read_capture(rng, folder):
    check_scene(load_scene(folder, **rng.choice(LOAD_OPTIONS)))


def make_pictures(folder):
    picture = np.random.default_rng(0).integers(0, 255, (24, 32, 4), np.uint8)
    write_image(folder / "a.jpg", picture[..., :3])
    write_image(folder / "b.png", picture)
    write_image(folder / "c.png", picture[..., 0])
    write_image(folder / "d.png", picture[..., :3].astype(np.uint16) * 257)
    write_image(folder / "e.tif", picture)


def read_pictures(rng, folder):
    for path in sorted(folder.iterdir()):
        image = read_image(path) if rng.random() < 0.7 else read_mask(path)
        check(image.dtype == np.uint8 and image.ndim in (2, 3) and image.size, "an image")


def make_points(folder):
    for name in ("ascii", "binary_little_endian", "binary_big_endian"):
        write_ply(folder / f"{name}.ply", vertices(), name)


def read_points(rng, folder):
    for path in sorted(folder.iterdir()):
        check(read_vertices(path).dtype.names is not None, "vertices")


def make_weights(folder):
    for name in ("tensors_zip.pth", "tensors_legacy.pth"):
        shutil.copy(TESTS / "data" / name, folder)


def read_weights(rng, folder):
    for path in sorted(folder.iterdir()):
        for array in read_tensors(path).values():
            check(array.dtype.kind in "fiu" and array.nbytes < 10**6, "a tensor")


def make_paths(folder):
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    cameras = [{"camera_to_world": pose.ravel().tolist(), "fov": 50, "aspect": 1.5}] * 3
    path = {"camera_type": "perspective", "render_height": 60, "render_width": 90, "fps": 24}
    text = json.dumps({**path, "seconds": 2, "default_fov": 40, "camera_path": cameras})
    (folder / "camera_path.json").write_text(text)
    transform = {"transform": np.eye(3, 4).tolist(), "scale": 0.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(transform))


def read_paths(rng, folder):
    transform, scale = read_camera_transform(folder / "dataparser_transforms.json")
    check_finite("a transform", transform)
    check(0 < scale < np.inf, "a scale")
    cameras = read_camera_path(folder / "camera_path.json").cameras
    check_finite("cameras", cameras.camtoworld, cameras.intrinsics)


@contextlib.contextmanager
def cache_in(folder):
    before = os.environ["XDG_CACHE_HOME"]
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    try:
        yield
    finally:
        os.environ["XDG_CACHE_HOME"] = before


def make_cached(folder):
    """A capture whose cache of shrunk photographs is in `cache`; the rest is not damaged."""
    single_file(folder / "capture", 2)
    read_cached(None, folder)


def read_cached(rng, folder):
    with cache_in(folder):
        check_scene(load_scene(folder / "capture", downscale=2))


class RunReader:
    """Reads runs; holds what an intact one is restored to."""

    def __init__(self, run):
        self.run = run
        record = read_run(run)
        self.preset, scene = record.preset, load_run_scene(record)
        shapes = state_shapes(Programs(record.preset, scene))
        self.like = jax.tree.map(lambda leaf: jax.numpy.zeros(leaf.shape, leaf.dtype), shapes)

    def make(self, folder):
        shutil.copytree(self.run, folder, dirs_exist_ok=True)
        TrainLog(folder).begin("baseline", [{"step": 1, "loss": 0.5, "skipped": 0}])

    def read(self, rng, folder):
        TrainLog(folder).begin("baseline", [{"step": 1, "loss": 0.5, "skipped": 0}])
        record = read_run(folder)
        check_scene(load_run_scene(record))
        if record.preset == self.preset:
            found = Checkpoints(folder / "checkpoints", record.identity).load("closeup", self.like)
            leaves = jax.tree.leaves(found[1] if found else ())
            is_key = [jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]
            check_finite(
                "a state", *(leaf for leaf, key in zip(leaves, is_key, strict=True) if not key)
            )


def wrong(good):
    """The changes that make a capture of a format wrong."""
    return [change for change, *_ in CASES[good]]


def cases(run):
    """Functions that make a folder and read it, and the pattern of the names to damage in it.

    A fourth value has changes that make the folder wrong.
    """
    reader = RunReader(run)
    return {
        "transforms": (make_paper, read_capture, "*", wrong(paper)),
        "fields": (make_single, read_capture, "*.json"),
        "files": (make_single, read_capture, "*", wrong(single)),
        "colmap text": (colmap, read_capture, "*.txt", wrong(colmap)),
        "colmap binary": (binary, read_capture, "*.bin", wrong(binary)),
        "llff": (make_llff, read_capture, "*.npy"),
        "capture of llff": (make_llff, read_capture, "*", wrong(llff)),
        "pictures": (make_pictures, read_pictures, "*"),
        "points": (make_points, read_points, "*"),
        "weights": (make_weights, read_weights, "*"),
        "camera paths": (make_paths, read_paths, "*"),
        "cache": (make_cached, read_cached, "*.photo"),
        "run": (reader.make, reader.read, "*"),
        "fields of a run": (reader.make, reader.read, "*.json*"),
    }


# The process that reads.


def outcome(rng, read, folder):
    """Read a damaged folder; return whether a reader refused it, and a fault or None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)  # of NumPy: numbers overflow in silence
            read(rng, folder)
    except ERRORS as error:
        text = str(error)
        sentence = text.isprintable() and 20 < len(text) < 1000
        return True, None if sentence else f"says {text[:300]!r}"
    except OSError as error:  # of logs, which say it in a sentence
        sentence = error.errno is None and "\n" not in str(error)
        return True, None if sentence else traceback.format_exc()
    except Exception:
        return True, traceback.format_exc()
    return False, None


def main():
    """Answer each number with a line of JSON."""
    folder, run = map(pathlib.Path, sys.argv[1:])
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    silent = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):  # C++ prints there too
        os.dup2(silent, number)
    os.environ["XDG_CACHE_HOME"] = str(folder / "no cache")
    made = cases(run)
    used = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + LARGEST, used + LARGEST))
    answers.write("ready\n")
    for number in map(int, sys.stdin):
        rng, start = random.Random(number), time.process_time()
        name = sorted(made)[number % len(made)]
        make, read, pattern, *changes = made[name]
        place = folder / f"read {number}"
        place.mkdir()
        make(place)
        for change in (rng.choice(some) for some in changes if rng.random() < WRONG):
            change(place)
        what = mutate(rng, place, pattern)
        refused, fault = outcome(rng, read, place)
        shutil.rmtree(place, ignore_errors=True)
        answer = {"case": name, "what": what, "refused": refused, "fault": fault}
        answer["seconds"] = time.process_time() - start
        answers.write(json.dumps(answer) + "\n")


# The test.


class Worker:
    """A process that reads damaged files, started again after each hang or crash."""

    def __init__(self, folder, run):
        self.refused, self.read_well = collections.Counter(), collections.Counter()
        self._command = [sys.executable, __file__, str(folder), str(run)]
        self._process = None

    def fault(self, number):
        """Read the folder of a number; return a fault as text, or None."""
        if self._process is None:
            self._start()
        self._process.stdin.write(f"{number}\n")
        line = self._line(PATIENCE * HANG)
        if not line:
            ended = (
                "no answer" if line is None else f"the process ended with {self._process.wait()}"
            )
            self.close()
            return f"{number}: {ended}"
        answer = json.loads(line)
        (self.refused if answer["refused"] else self.read_well)[answer["case"]] += 1
        fault = answer["fault"]
        if answer["seconds"] > HANG:
            fault = f"took {answer['seconds']:.0f} s"
        return fault and f"{number}, {answer['case']}, {answer['what']}: {fault}"

    def _start(self):
        path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path, "XLA_FLAGS": ""},
            text=True,
            bufsize=1,
        )
        assert self._line(120) == "ready\n", "the process does not start"

    def _line(self, seconds):
        """Return a line; an empty one if the process ended, None if it says nothing so long."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            return self._process.stdout.readline() if selector.select(seconds) else None

    def close(self):
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@pytest.fixture
def worker(tmp_path, kept):
    pytest.importorskip("pycolmap")
    worker = Worker(tmp_path, kept)
    yield worker
    worker.close()


def test_damaged_files_are_refused_in_a_sentence_or_read_sanely(worker):
    first, colon, last = os.environ.get("JAXCLOSEUP_FUZZ", str(MUTATIONS)).partition(":")
    numbers = range(int(first), int(last)) if colon else range(int(first))
    faults = [fault for number in numbers if (fault := worker.fault(number))]
    print(f"refused: {dict(worker.refused)}; read: {dict(worker.read_well)}")
    assert not faults, f"{len(faults)} of {len(numbers)}:\n" + "\n".join(faults)
    if len(numbers) >= MUTATIONS:  # most damage is seen, and some does no harm
        for outcomes in (worker.refused, worker.read_well):
            assert len(outcomes) > 10 and sum(outcomes.values()) > len(numbers) / 10


if __name__ == "__main__":
    main()
