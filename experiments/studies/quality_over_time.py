"""Quality over minutes of training: the figure and the table of docs/results.md.

    python -m experiments.studies.quality_over_time --capture=path/to/plush

makes runs with `--minutes` in `outputs/studies`, unless they are there, and draws the PSNR of
close-ups, color-corrected for the capture, over the minutes. Where another program's scores are
known, at the size of training, ours at that size stand beside them.
"""

import pathlib

from absl import app, flags

from experiments.studies.tables import (
    CLOSEUPS,
    ORDINARY,
    Results,
    field_and_detail,
    finished_runs,
    pair,
    print_table,
    score,
)
from jaxcloseup.app.report.plots import Curve, line_plot
from jaxcloseup.io.files import write_file


FLAGS = flags.FLAGS
_REDUCED = "test_reduced"  # close-ups at the size of the reduced photographs
# What OpenSplat 1.1.5 makes of a capture: color-corrected close-ups reduced to 100 x 75, after
# 185 core-seconds in 3 minutes (2000 steps at that size) and 684 in 12 (4000, up to 400 x 300).
_OTHERS = {"plush": Curve("plush at 100 x 75, OpenSplat", [3, 12], [23.58, 26.29])}


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("scenes", ["table"], "drawn scenes")
    flags.DEFINE_string("capture", None, "folder of a real capture")
    flags.DEFINE_list("minutes", ["1", "3", "10", "30"], "minutes of training")
    flags.DEFINE_string("output_dir", "outputs/studies", "folder of the runs to make")
    flags.DEFINE_string("output", "docs/quality_over_time.svg", "figure to write")


def main(_: list[str]) -> None:
    """Print the table and write the figure."""
    scenes = [*FLAGS.scenes, *filter(None, [FLAGS.capture])]
    rows, curves = [], []
    for scene in scenes:
        name = pathlib.Path(scene).name
        metric = "cc_psnr" if scene == FLAGS.capture else "psnr"
        runs = {minutes: _run(scene, minutes) for minutes in FLAGS.minutes}
        rows += [[name, minutes, *_cells(results, metric)] for minutes, results in runs.items()]
        curves += _curves(name, runs, CLOSEUPS, metric)
        if name in _OTHERS:
            curves += [*_curves(f"{name} reduced", runs, _REDUCED, metric), _OTHERS[name]]
    header = ["scene", "minutes", "surfels", "steps", "close-ups", "resolves (px)", "ordinary"]
    header += ["close-ups, reduced"]
    print_table("Quality over time, field / with detail", header, rows)
    drawn = line_plot(
        curves, x="minutes of training", y="PSNR (dB)", title="Close-ups", doubling=True
    )
    write_file(pathlib.Path(FLAGS.output), drawn.encode())


def _run(scene: str, minutes: str) -> Results:
    root = pathlib.Path(FLAGS.output_dir, f"minutes_{minutes}")
    flags_of_run = ("--stages=detail", f"--minutes={minutes}")
    (results,) = finished_runs([], root, [scene], *flags_of_run).values()
    return results


def _curves(name: str, runs: dict[str, Results], split: str, metric: str) -> list[Curve]:
    """Return scores over the minutes, of the field and with detail."""
    return [
        Curve(
            f"{name}, {title}",
            [float(minutes) for minutes in runs],
            [
                score(found, field_and_detail(found)[number], split, metric)
                for found in runs.values()
            ],
        )
        for number, title in enumerate(("field", "with detail"))
    ]


def _cells(results: Results, metric: str) -> list[str]:
    config, both = results["config"], field_and_detail(results)
    return [
        f"{config['field']['capacity']:,}",
        f"{config['baseline_steps']:,}",
        pair(results, both, CLOSEUPS, metric),
        pair(results, both, CLOSEUPS, "resolves", 1),
        pair(results, both, ORDINARY, metric),
        pair(results, both, _REDUCED, metric),
    ]


if __name__ == "__main__":
    define_flags()
    app.run(main)
