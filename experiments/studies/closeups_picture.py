"""Picture held-out close-ups of default runs: truth, the field alone, and with detail.

    python -m experiments.studies.closeups_picture --runs=outputs/table
    python -m experiments.studies.closeups_picture --output=docs/closeups_worst.jpg \\
        --runs=outputs/bench,outputs/counter,...

Of one run, from above: the close-up in which detail gains most, the middle one, and the one in
which it gains least. Of several, the close-up of each that has the lowest PSNR with detail.
"""

import pathlib

import numpy as np
from absl import app, flags

from experiments.studies.pictures import (
    closeup_camera,
    render_detailed,
    render_plain,
    render_truth,
    write_rows,
)
from experiments.trained_run import open_run
from jaxcloseup.app.report.showcase import best_middle_worst
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
_STAGE = "control"


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", None, "folders of default runs of drawn scenes")
    flags.DEFINE_string("output", "docs/closeups_table.jpg", "picture to write")
    flags.DEFINE_integer("width", 480, "width of each panel in pixels", lower_bound=1)
    flags.mark_flags_as_required(["runs"])


def main(_: list[str]) -> None:
    """Render the close-ups, and write the picture."""
    rows = []
    for folder in map(pathlib.Path, FLAGS.runs):
        run = open_run(folder, _STAGE)
        for name in _chosen(folder, one=len(FLAGS.runs) == 1):
            camera = closeup_camera(run, name, FLAGS.width)
            sharp = np.asarray(render_detailed(run, camera).rgb)
            rows.append([render_truth(run, camera), render_plain(run, camera), sharp])
    write_rows(FLAGS.output, rows, labels=["truth", "field", "with detail"])


def _chosen(folder: pathlib.Path, *, one: bool) -> list[str]:
    """Return the names of a run's close-ups to show, whether it is the only run or not."""
    stages = read_object(folder / "results.json")["stages"]
    field, detail = (stages[name]["test"]["views"] for name in (_STAGE, "detail"))
    if not one:
        return [min(detail, key=lambda name: detail[name]["psnr"])]
    gained = {name: detail[name]["psnr"] - field[name]["psnr"] for name in detail}
    return best_middle_worst(gained)


if __name__ == "__main__":
    define_flags()
    app.run(main)
