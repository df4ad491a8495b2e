"""Picture docs/expected_error.jpg: renders with detail, truth, expected and actual errors.

    python -m experiments.studies.expected_error \\
        --runs=outputs/studies/default/table,outputs/studies/default/counter

Each run shows one close-up: the one whose PSNR with detail is the middle one, or `--views`.
"""

import pathlib

import numpy as np
from absl import app, flags

from experiments.studies.pictures import closeup_camera, render_detailed, render_truth, write_rows
from experiments.studies.trained_run import open_run
from jaxcloseup.app.report.showcase import best_middle_worst
from jaxcloseup.artifacts.images import colorize_expected_error
from jaxcloseup.io.files import read_object


FLAGS = flags.FLAGS
_LABELS = ("render with detail", "truth", "expected error", "actual error")


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", None, "folders of runs of drawn scenes with the stage detail")
    flags.DEFINE_list("views", [], "name of a close-up for each run")
    flags.DEFINE_string("output", "docs/expected_error.jpg", "picture to write")
    flags.DEFINE_integer("width", 360, "width of each panel in pixels", lower_bound=1)
    flags.mark_flag_as_required("runs")


def main(_: list[str]) -> None:
    """Render a close-up of each run, and write the picture."""
    rows = []
    for index, folder in enumerate(map(pathlib.Path, FLAGS.runs)):
        results = read_object(folder / "results.json")
        run = open_run(folder, results["detail"]["stage"])
        views = results["stages"]["detail"]["test"]["views"]
        ranked = best_middle_worst({name: view["psnr"] for name, view in views.items()})
        name = FLAGS.views[index] if FLAGS.views else ranked[len(ranked) // 2]
        camera = closeup_camera(run, name, FLAGS.width)
        truth, sharp = render_truth(run, camera), render_detailed(run, camera)
        expected, rgb = np.asarray(sharp.error), np.asarray(sharp.rgb)
        actual = np.where(np.isfinite(expected), np.abs(rgb - truth).mean(-1), np.nan)
        rows.append([rgb, truth, *map(colorize_expected_error, (expected, actual))])
    write_rows(FLAGS.output, rows, _LABELS)


if __name__ == "__main__":
    define_flags()
    app.run(main)
