"""Picture held-out close-ups of default runs: truth, the field alone, and with detail.

    python -m experiments.studies.closeups_picture --runs=outputs/table
    python -m experiments.studies.closeups_picture --output=docs/closeups_worst.jpg \\
        --runs=outputs/bench,outputs/counter,...

It shows the three close-ups of one run in which detail gains most, in the middle and least, or of
several runs the close-up of each that has the lowest PSNR with detail.
"""

import pathlib

import cv2
import imageio.v3 as imageio
import numpy as np
from absl import app, flags

from experiments.studies.pictures import write_rows
from experiments.studies.tables import CLOSEUPS, field_and_detail
from jaxcloseup.app.report.showcase import best_middle_worst
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", None, "folders of default runs")
    flags.DEFINE_string("output", "docs/closeups_table.jpg", "picture to write")
    flags.DEFINE_integer("width", 480, "width of each panel in pixels", lower_bound=1)
    flags.mark_flags_as_required(["runs"])


def main(_: list[str]) -> None:
    """Put renders that runs keep beside the truth, and write the picture."""
    rows = []
    for folder in map(pathlib.Path, FLAGS.runs):
        results = read_object(folder / "results.json")
        both = field_and_detail(results)
        plain, views = (results["stages"][name][CLOSEUPS]["views"] for name in both)
        chosen = [min(views, key=lambda name: views[name]["psnr"])]
        if len(FLAGS.runs) == 1:
            gained = {name: views[name]["psnr"] - plain[name]["psnr"] for name in views}
            chosen = best_middle_worst(gained)
        rows += [[_panel(folder, stage, name) for stage in ("truth", *both)] for name in chosen]
    write_rows(FLAGS.output, rows, labels=["truth", "field", "with detail"])


def _panel(folder: pathlib.Path, stage: str, name: str) -> np.ndarray:
    """Return a close-up that a run keeps, with the width of a panel."""
    image = imageio.imread(folder / "renders" / stage / "test" / "rgb" / f"{name}.png")
    height = round(FLAGS.width * image.shape[0] / image.shape[1])
    return cv2.resize(image, (FLAGS.width, height), interpolation=cv2.INTER_AREA) / np.float32(255)


if __name__ == "__main__":
    define_flags()
    app.run(main)
