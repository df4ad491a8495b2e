"""Finished runs beside each other: what `experiments.compare` does."""

import datetime
import pathlib
import sys

from absl import flags

from jaxcloseup.app.cli.start import check_unused, prepare_to_stop
from jaxcloseup.app.report.comparison import (
    comparison_tables,
    say_which_is_best,
    write_comparison,
)
from jaxcloseup.app.report.finished_runs import read_finished
from jaxcloseup.app.report.table import print_tables
from jaxcloseup.app.store.stored_run import RunError


FLAGS = flags.FLAGS


def main() -> None:
    """Compare the runs that the flags name."""
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
