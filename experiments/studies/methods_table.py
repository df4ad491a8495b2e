"""Table of all methods on all scenes, from `methods.json` of a sweep.

    python -m experiments.sweep --output_dir=outputs/methods --seeds=1 --max_parallel=1 \\
        --methods=ngp,nerf,dsnerf,mipnerf,tensorf,zipnerf,gaussians,mip_gaussians,surfels \\
        --scenes=bench,counter,room,stairs,table,path/to/plush \\
        --arms=baseline,control,diverse,test_time
    python -m experiments.studies.methods_table --sweep=outputs/methods
"""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from absl import app, flags

from experiments.studies.tables import CLOSEUPS, ORDINARY, SCENES, print_table
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
Record = Mapping[str, Any]  # of a method on a scene
_FAILED: Record = {"arms": {}, "core_seconds": None}


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_string("sweep", "outputs/methods", "folder of the sweep")
    flags.DEFINE_string("arm", "control", "arm to show")


def main(_: list[str]) -> None:
    """Print the mean of the drawn scenes, and each capture beside it."""
    print_methods(read_object(pathlib.Path(FLAGS.sweep) / "methods.json"), FLAGS.arm)


def print_methods(methods: Mapping[str, Mapping[str, Record]], arm: str) -> None:
    """Print PSNR, depth error and time of an arm by method."""
    names = list(dict.fromkeys(name for scenes in methods.values() for name in scenes))
    drawn = [name for name in names if name in SCENES]
    groups = {f"{len(drawn)} drawn scenes": drawn} if drawn else {}
    groups |= {name: [name] for name in names if name not in SCENES}
    header = ["method"]
    for title in groups:
        header += [f"{title}: close-ups / ordinary", "depth off by, %"]
    rows = []
    for method, scenes in methods.items():
        row = [method]
        for group in groups.values():
            records = [scenes.get(name, _FAILED) for name in group]
            row += [_pair(records, arm, "psnr", "{:.2f}".format)]
            row += [_pair(records, arm, "depth", lambda value: f"{100 * value:.1f}")]
        seconds = [scenes.get(name, _FAILED)["core_seconds"] for name in names]
        rows.append([*row, f"{np.mean(seconds) / 60:.1f}" if all(seconds) else "-"])
    print_table(f"Methods, {arm}", [*header, "core-minutes"], rows)


def _pair(records: Sequence[Record], arm: str, metric: str, write: Callable[[float], str]) -> str:
    """Format the means over scenes of a metric of close-ups and of ordinary views.

    It is "-" unless all scenes have it, because scenes are not equally hard.
    """
    texts = []
    for split in (CLOSEUPS, ORDINARY):
        scores = [record["arms"].get(arm, {}).get(split, {}) for record in records]
        known = [one[metric] for one in scores if one.get(metric) is not None]
        texts.append(write(float(np.mean(known))) if len(known) == len(records) else "-")
    return " / ".join(texts)


if __name__ == "__main__":
    define_flags()
    app.run(main)
