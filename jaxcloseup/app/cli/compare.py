"""Compare several finished runs on one scene.

    jaxcloseup compare --runs=outputs/table/surfels/...,outputs/table/nerf/...

The program reads the scores and pictures that the runs left, prints a table for each kind of view,
and writes `report.html`, one page that needs no other file, and `compare.json`.
"""

import pathlib

from absl import flags

from jaxcloseup.app.cli.flags import OUTPUT
from jaxcloseup.app.cli.output_folder import check_unused, dated, prepare_to_stop
from jaxcloseup.app.cli.start import in_one_sentence, loading
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
share(OUTPUT)
flags.DEFINE_list("runs", [], "folders of finished runs, between commas")


def main(_: list[str]) -> None:
    """Compare the runs that the flags name."""
    with loading():
        from jaxcloseup.app.report.comparison import (
            comparison_tables,
            say_which_is_best,
            write_comparison,
        )
        from jaxcloseup.app.report.finished_runs import read_finished
        from jaxcloseup.app.report.record_table import print_tables
        from jaxcloseup.app.store.stored_run import RunError

    with in_one_sentence("compare", RunError, OSError):
        folder = check_unused(FLAGS.output_dir or dated(pathlib.Path("outputs", "compare")))
        prepare_to_stop(folder)
        runs = read_finished(FLAGS.runs)
        write_comparison(folder, runs)
    print_tables(comparison_tables(runs), say_which_is_best(runs))
    print(f"report: {folder / 'report.html'}")
