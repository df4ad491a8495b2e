"""Picture docs/closeups_table.jpg: truth, a field of reduced photographs, default, with detail.

    python -m experiments.studies.closeups_picture \\
        --reduced=outputs/studies/reduced/table --default=outputs/studies/default/table

From above: the close-up in which the default gains most over the other run, the middle one, and
the one in which it gains least.
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


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_string("reduced", None, "folder of a run with --preset=reduced")
    flags.DEFINE_string("default", None, "folder of a default run of the same scene")
    flags.DEFINE_string("stage", "control", "stage of both runs to render")
    flags.DEFINE_string("output", "docs/closeups_table.jpg", "picture to write")
    flags.DEFINE_integer("width", 398, "width of each panel in pixels", lower_bound=1)
    flags.mark_flags_as_required(["reduced", "default"])


def main(_: list[str]) -> None:
    """Render three close-ups of both runs, and write the picture."""
    folders = [pathlib.Path(folder) for folder in (FLAGS.reduced, FLAGS.default)]
    before, after = (
        read_object(folder / "results.json")["stages"][FLAGS.stage]["test"]["views"]
        for folder in folders
    )
    gained = {name: after[name]["psnr"] - before[name]["psnr"] for name in after}
    reduced, default = (open_run(folder, FLAGS.stage) for folder in folders)
    rows = []
    for name in best_middle_worst(gained):
        camera = closeup_camera(default, name, FLAGS.width)
        sharp = np.asarray(render_detailed(default, camera).rgb)
        plain = [render_plain(run, camera) for run in (reduced, default)]
        rows.append([render_truth(default, camera), *plain, sharp])
    write_rows(FLAGS.output, rows, labels=None)


if __name__ == "__main__":
    define_flags()
    app.run(main)
