"""Benchmarks: `python -m experiments.bench --suite=nerf,warp`.

Each suite measures its alternatives and its ceiling in one process, interleaved, and prints medians
and ratios. Absolute times belong to the machine and the hour; ratios carry over.
"""

import importlib

from absl import app, flags


SUITES = ("nerf", "warp", "labels", "splats", "sweep", "resume")

_SUITE = flags.DEFINE_list("suite", ["nerf", "warp"], f"suites to run, of {', '.join(SUITES)}")


def main(_: list[str]) -> None:
    """Run the suites in the order given."""
    for suite in _SUITE.value:
        importlib.import_module(f"experiments.benchmarks.{suite}").run()


@flags.multi_flags_validator(["suite"], message=f"--suite takes names out of {', '.join(SUITES)}")
def _known(values: dict[str, list[str]]) -> bool:
    return bool(values["suite"]) and set(values["suite"]) <= set(SUITES)


if __name__ == "__main__":
    app.run(main)
