"""Make the runs that teach the weights of detail, also sparse ones and ones with inexact poses.

    python -m experiments.studies.detail_teachers
    python -m experiments.bench --suite=teach

makes, in `outputs/teach`, default runs of the drawn scenes with all photographs, with 10 and with
6, of a volumetric field, and of captures whose training poses are turned at random by about half a
pixel; what is there is not made again, what was cut off is resumed. The second command learns from
them. `--shown` prints how many held-out views of these runs lose by detail, and how much.
"""

import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from absl import flags

from experiments.studies.tables import (
    CLOSEUPS,
    ORDINARY,
    SCENES,
    Results,
    field_and_detail,
    finished_runs,
    print_table,
)
from jaxcloseup.app.cli.start import loading, set_up_compilation_cache, start
from jaxcloseup.app.view.exporting import export_cameras
from jaxcloseup.captures.load import load_scene
from jaxcloseup.io.files import read_object, write_json


FLAGS = flags.FLAGS
_STAGES = ("--stages=baseline,detail",)
_NGP = ("--method=ngp",)
# Flags of the runs by kind, and their scenes. A kind whose name begins with `noise` trains on a
# capture with inexact poses.
KINDS: dict[str, tuple[Sequence[str], Sequence[str]]] = {
    "all": ((), SCENES),
    "10": (("--photographs=10", "--choose=spread"), SCENES),
    "6": (("--photographs=6", "--choose=spread"), ("counter", "stairs")),
    "noise": ((), ("room", "table")),
    "ngp_10": ((*_NGP, "--photographs=10", "--choose=spread"), ("room", "table")),
    "ngp_10_colors": (
        (*_NGP, "--photographs=10", "--choose=spread", "--set=depth_weight=0"),
        ("room", "table"),
    ),
}
NOISE = 0.5  # pixels of the photographs by which a pose is off, standard deviation of each axis
LOST = 0.1  # dB of color-corrected PSNR


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("kinds", list(KINDS), "kinds of runs to make")
    flags.DEFINE_bool("shown", False, "print the views that detail harms in `--runs` instead")
    flags.DEFINE_list("runs", [], "folders of runs; those in `--output_dir` by default")
    flags.DEFINE_string("output_dir", "outputs/teach", "folder of the runs to make")


def main(_: list[str]) -> None:
    """Make the runs, or print what detail does in them."""
    root = pathlib.Path(FLAGS.output_dir)
    if FLAGS.shown:
        folders = map(pathlib.Path, FLAGS.runs) if FLAGS.runs else sorted(root.glob("*/*"))
        print_harm([folder for folder in folders if (folder / "results.json").exists()])
        return
    with loading():
        set_up_compilation_cache(None)
    for kind in FLAGS.kinds:
        given, scenes = KINDS[kind]
        for name in scenes:
            captures = root / "captures"
            scene = str(noisy_capture(name, captures)) if kind.startswith("noise") else name
            finished_runs([], root / kind, [scene], *_STAGES, *given)


def noisy_capture(name: str, root: pathlib.Path) -> pathlib.Path:
    """Write a drawn scene as a capture whose training poses are inexact; return its folder."""
    folder = root / name
    about = folder / "noise.json"
    if about.exists() and read_object(about) == {"pixels": NOISE}:
        return folder
    export_cameras(folder, load_scene(name))
    path = folder / "transforms.json"
    write_json(path, turn_training_poses(read_object(path), np.random.default_rng(0)))
    write_json(about, {"pixels": NOISE})
    return folder


def turn_training_poses(listed: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Turn the training cameras of a `transforms.json` at random about each of their axes."""
    frames = []
    for frame in listed["frames"]:
        pose = np.array(frame["transform_matrix"])
        if frame["file_path"] in listed["train_filenames"]:
            turn = rng.normal(scale=NOISE / frame["fl_x"], size=3)
            pose[:3, :3] @= cv2.Rodrigues(turn)[0]
        frames.append({**frame, "transform_matrix": pose.tolist()})
    return {**listed, "frames": frames}


def print_harm(folders: Sequence[pathlib.Path]) -> None:
    """Print the mean gain of detail and the views that lose, for every run."""
    rows, every = [], []
    for folder in folders:
        results = read_object(folder / "results.json")
        for split in (CLOSEUPS, ORDINARY):
            gained = corrected_gains(results, split)
            every += gained.values()
            if gained:
                worst, mean = min(gained.values()), np.mean([*gained.values()])
                lost = [f"{view} {gain:+.2f}" for view, gain in gained.items() if gain < -LOST]
                name = f"{folder.parent.name}/{folder.name}"
                figures = str(len(gained)), f"{mean:+.2f}", f"{worst:+.2f}"
                rows.append([name, split, *figures, ", ".join(lost)])
    header = ["run", "views", "number", "mean gain (dB, color-corrected)", "worst", "lose"]
    print_table("What detail adds", header, rows)
    losing = np.array(every) < -LOST
    shown = f"{losing.sum()} of {losing.size} views lose more than {LOST} dB"
    print(f"{shown}: {losing.mean():.1%}" if every else shown)


def corrected_gains(results: Results, split: str) -> dict[str, float]:
    """Return by how many dB detail raises the color-corrected PSNR of each view of a split."""
    field, detail = field_and_detail(results)
    stages = results["stages"]
    views = stages.get(detail, {}).get(split, {}).get("views", {})
    others = stages[field].get(split, {}).get("views", {})
    return {name: view["cc_psnr"] - others[name]["cc_psnr"] for name, view in views.items()}


if __name__ == "__main__":
    define_flags()
    start(sys.modules[__name__])
