"""Table of what the check finds in damaged captures, and in harmless variations of right ones.

    python -m experiments.studies.capture_checks --captures=FOLDER,FOLDER

Every capture is damaged in `--damages` ways, drawn from a seed, and varied in `--harmless` ways
that change nothing: photographs encoded anew, of half the size, in another order, with masks.
"""

import collections
import json
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from absl import app, flags

from experiments.studies.tables import print_table
from jaxcloseup.app import progress
from jaxcloseup.captures.contents import Listed, list_photographs
from jaxcloseup.captures.corrections import correct_poses
from jaxcloseup.captures.photo import Reading
from jaxcloseup.checks.epipolar import Cameras
from jaxcloseup.checks.evidence import Evidence, gather
from jaxcloseup.checks.judge import FITS, Checked, judge


FLAGS = flags.FLAGS
_MOST = 40  # photographs of a capture
_Change = Callable[[Cameras, np.ndarray, np.random.Generator], tuple[Cameras, np.ndarray]]


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("captures", None, "folders of right captures", required=True)
    flags.DEFINE_integer("damages", 200, "damaged captures, over all folders")
    flags.DEFINE_integer("harmless", 100, "harmless variations, over all folders")
    flags.DEFINE_string("output", None, "JSON file for what was found in each")


class Damage(NamedTuple):
    """A way to damage a capture."""

    change: _Change
    named: bool  # whether it is a known mistake
    points: bool = False  # whether it is one of points alone


def main(_: list[str]) -> None:
    """Damage and vary the captures, and print the tables."""
    folders = [pathlib.Path(folder) for folder in FLAGS.captures]
    damaged, records = collections.defaultdict(list), []
    harmless: dict[str, list[Checked]] = collections.defaultdict(list)
    for number, folder in enumerate(folders):
        listed, evidence = _read(folder)
        right = judge(evidence, listed.points, opengl=listed.format == "transforms")
        print(f"{folder.name}: {right.sentence}")
        kinds = [kind for kind in DAMAGES if len(listed.points) or not DAMAGES[kind].points]
        for kind, seed in _share(kinds, FLAGS.damages, number, len(folders)):
            found = _damage(listed, evidence, kind, np.random.default_rng(seed))
            damaged[kind].append(found)
            record = {"capture": folder.name, "kind": kind, "seed": seed}
            records.append(record | {"sentence": found.sentence, "verdict": found.verdict})
        for kind, seed in _share(list(_HARMLESS), FLAGS.harmless, number, len(folders)):
            found = _vary(folder, kind, np.random.default_rng(seed))
            harmless[kind].append(found)
            records.append({"capture": folder.name, "kind": kind, "sentence": found.sentence})
    rows = [_row(kind, found) for kind, found in damaged.items()]
    print_table("Damaged captures", ["damage", "captures", "noticed", "named"], rows)
    rows = [
        [kind, str(len(found)), str(sum(one.verdict != FITS or bool(one.points) for one in found))]
        for kind, found in harmless.items()
    ]
    print_table("Harmless variations", ["variation", "captures", "false alarms"], rows)
    if FLAGS.output:
        pathlib.Path(FLAGS.output).write_text(json.dumps(records, indent=1))


def _share(kinds: list[str], total: int, number: int, folders: int) -> Iterator[tuple[str, int]]:
    """Yield the kinds and seeds that one of several captures gets."""
    seeds = [seed for seed in range(total) if seed % folders == number]
    for i, seed in enumerate(progress.track(seeds, "captures")):
        yield kinds[(i + 5 * number) % len(kinds)], seed


def _read(folder: pathlib.Path) -> tuple[Listed, Evidence]:
    listed = list_photographs(folder)
    step = -(-len(listed.frames) // _MOST)
    return listed, gather(listed.frames[::step], Reading())


def _damage(listed: Listed, evidence: Evidence, kind: str, rng: np.random.Generator) -> Checked:
    opengl = listed.format == "transforms"
    cameras, points = DAMAGES[kind].change(evidence.cameras, listed.points, rng)
    if kind in ("inverse", "axes", "both"):
        poses = cameras.camtoworld
        for correction in {"both": ("axes", "inverse")}.get(kind, (kind,)):
            poses = correct_poses(poses, correction, opengl=opengl)
        cameras = cameras._replace(camtoworld=poses)
    return judge(evidence._replace(cameras=cameras), points, opengl=opengl)


def _row(kind: str, found: list[Checked]) -> list[str]:
    damage = DAMAGES[kind]
    noticed = [one.verdict != FITS or bool(one.points) for one in found]
    named = [bool(one.points if damage.points else one.corrections) for one in found]
    share = f"{sum(named)}" if damage.named else "-"
    return [kind, str(len(found)), str(sum(noticed)), share]


def _keep(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    return cameras, points


def _ordered(choose: Callable[[int, np.random.Generator], np.ndarray]) -> _Change:
    def change(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
        order = choose(len(cameras.camtoworld), rng)
        return cameras._replace(camtoworld=cameras.camtoworld[order]), points

    return change


def _exchange(count: int, rng: np.random.Generator) -> np.ndarray:
    order = np.arange(count)
    some = rng.choice(count, 2 * rng.integers(1, 4), replace=False)
    order[some] = order[some[::-1]]
    return order


def _noise(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    """Turn cameras at random so that the middle of photographs moves by 1 to 50 pixels."""
    pixels = float(np.exp(rng.uniform(0, np.log(50))))
    turned = [
        pose[:, :3] @ cv2.Rodrigues(rng.normal(scale=pixels / lens[0], size=3))[0]
        for pose, lens in zip(cameras.camtoworld, cameras.intrinsics, strict=True)
    ]
    poses = np.concatenate([np.stack(turned), cameras.camtoworld[:, :, 3:]], -1)
    return cameras._replace(camtoworld=poses), points


def _resize(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    factor = float(np.exp(rng.uniform(0.2, 1.4) * rng.choice([-1, 1])))
    return cameras._replace(intrinsics=cameras.intrinsics * factor), points


def _crop(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    moved = rng.uniform(0.08, 0.25, 2) * rng.choice([-1, 1], 2) * cameras.sizes
    lenses = cameras.intrinsics + np.concatenate([np.zeros_like(moved), moved], -1)
    return cameras._replace(intrinsics=lenses), points


def _refocus(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    factor = float(np.exp(rng.uniform(0.1, 0.7) * rng.choice([-1, 1])))
    return cameras._replace(intrinsics=cameras.intrinsics * [factor, factor, 1, 1]), points


def _turned_points(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    matrix = np.array([[[1, 0, 0], [0, 0, 1], [0, -1, 0]], [[0, 1, 0], [0, 0, 1], [1, 0, 0]]])
    chosen = [*matrix, np.diag([1, -1, -1])][rng.integers(3)]
    return cameras, points @ chosen.T


def _moved_points(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    away = np.median(np.linalg.norm(points - cameras.camtoworld[0, :, 3], axis=-1))
    direction = rng.normal(size=3)
    return cameras, points + rng.uniform(0.15, 0.8) * away * direction / np.linalg.norm(direction)


def _scaled_points(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    middle = np.median(cameras.camtoworld[:, :, 3], 0)
    return cameras, middle + (points - middle) * np.exp(rng.uniform(0.2, 1) * rng.choice([-1, 1]))


def _random_points(cameras: Cameras, points: np.ndarray, rng: np.random.Generator) -> tuple:
    low, high = np.percentile(points, [2, 98], axis=0)
    return cameras, rng.uniform(low, high, (20_000, 3))


DAMAGES = {
    "axes": Damage(_keep, named=True),
    "inverse": Damage(_keep, named=True),
    "both": Damage(_keep, named=True),
    "any order": Damage(_ordered(lambda count, rng: rng.permutation(count)), named=True),
    "reverse order": Damage(_ordered(lambda count, rng: np.arange(count)[::-1]), named=True),
    "shifted order": Damage(
        _ordered(lambda count, rng: np.roll(np.arange(count), rng.integers(1, 4))), named=True
    ),
    "exchanged photographs": Damage(_ordered(_exchange), named=True),
    "intrinsics of another size": Damage(_resize, named=True),
    "cropped": Damage(_crop, named=True),
    "focal length": Damage(_refocus, named=True),
    "noise of 1 to 50 px": Damage(_noise, named=False),
    "points turned": Damage(_turned_points, named=True, points=True),
    "points moved": Damage(_moved_points, named=False, points=True),
    "points scaled": Damage(_scaled_points, named=False, points=True),
    "points random": Damage(_random_points, named=False, points=True),
}


def _vary(folder: pathlib.Path, kind: str, rng: np.random.Generator) -> Checked:
    """Check a copy of a capture with photographs that are changed without harm."""
    with tempfile.TemporaryDirectory() as parent:
        copy = pathlib.Path(parent) / folder.name
        shutil.copytree(folder, copy)
        listed = list_photographs(copy)
        frames = listed.frames[rng.integers(2) :: -(-len(listed.frames) // _MOST)]
        for file in sorted({frame.file for frame in frames}):
            _HARMLESS[kind](file, rng)
        listed = list_photographs(copy)
        kept = {frame.file for frame in frames}
        frames = [frame for frame in listed.frames if frame.file in kept]
        if kind == "another order":
            frames = [frames[i] for i in rng.permutation(len(frames))]
        evidence = gather(frames, Reading())
        return judge(evidence, listed.points, opengl=listed.format == "transforms")


def _encode(file: pathlib.Path, rng: np.random.Generator) -> None:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    quality = int(rng.integers(60, 98))
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    if file.suffix.lower() == ".png":
        data = cv2.imencode(".png", cv2.imdecode(data, cv2.IMREAD_COLOR))[1]
    file.write_bytes(data.tobytes())


def _halve(file: pathlib.Path, rng: np.random.Generator) -> None:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    file.write_bytes(cv2.imencode(file.suffix, small)[1].tobytes())


def _mask(file: pathlib.Path, rng: np.random.Generator) -> None:
    image = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = image.shape[:2]
    mask = np.full((height, width), 255, np.uint8)
    x, y = rng.uniform(0.2, 0.8, 2) * [width, height]
    cv2.circle(mask, (int(x), int(y)), int(0.25 * min(width, height)), 0, -1)
    cv2.imwrite(str(file.with_name(f"{file.stem}.mask.png")), mask)


_HARMLESS = {
    "encoded anew": _encode,
    "half the size": _halve,
    "another order": lambda file, rng: None,
    "masks": _mask,
}


if __name__ == "__main__":
    define_flags()
    app.run(main)
