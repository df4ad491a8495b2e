"""Compare several finished runs on one scene.

    python -m experiments.compare --runs=outputs/table/surfels/...,outputs/table/nerf/...

The program reads the scores and pictures that the runs left, prints a table for each kind of view,
and writes `report.html`, one page that needs no other file, and `compare.json`.
"""

from absl import flags

from jaxcloseup.app.cli.start import job


flags.declare_key_flag("output_dir")
flags.DEFINE_list("runs", [], "folders of finished runs of experiments.run, between commas")


def main(_: list[str]) -> None:
    """Compare the runs that the flags name."""
    job("compare").main()
