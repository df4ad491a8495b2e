"""Compare several finished runs on one scene.

    python -m experiments.compare --runs=outputs/table/surfels/...,outputs/table/nerf/...

The program reads the scores and pictures that the runs left, prints a table for each kind of view,
and writes `report.html`, one page that needs no other file, and `compare.json`.
"""

from absl import flags

from experiments.command_line import job, start


flags.declare_key_flag("output_dir")
flags.DEFINE_list("runs", [], "folders of finished runs of experiments.run, between commas")


def main(_: list[str]) -> None:
    """Compare the runs that the flags name."""
    job("compare").main()


if __name__ == "__main__":
    start(main)
