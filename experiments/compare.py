"""Compare several finished runs on one scene.

    python -m experiments.compare --runs=outputs/table/surfels/...,outputs/table/nerf/...

The program reads the scores and pictures that the runs left, prints a table for each kind of view,
and writes `report.html`, one page that needs no other file, and `compare.json`.
"""

import datetime
import pathlib
import sys

from absl import app, flags

from experiments.command_line import check_unused, prepare_to_stop, start
from experiments.reporting.comparison import (
    comparison_tables,
    read_finished,
    say_which_is_best,
    write_comparison,
)
from experiments.reporting.report import print_tables
from experiments.training.stored_run import RunError


FLAGS = flags.FLAGS
flags.declare_key_flag("output_dir")
flags.DEFINE_list("runs", [], "folders of finished runs of experiments.run, between commas")


def main(argv: list[str]) -> None:
    """Compare the runs that the flags name."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H%M%S")
    try:
        folder = check_unused(FLAGS.output_dir or pathlib.Path("outputs", "compare", stamp))
        prepare_to_stop(folder)
        runs = read_finished(FLAGS.runs)
        write_comparison(folder, runs)
    except (RunError, OSError) as error:
        sys.exit(f"experiments.compare: {error}")
    print_tables(comparison_tables(runs), say_which_is_best(runs))
    print(f"report: {folder / 'report.html'}")


if __name__ == "__main__":
    start(main)
