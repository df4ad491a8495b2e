"""Benchmarks: `python -m experiments.bench --suite=nerf,warp`.

Each suite times its alternatives and its upper bound in one process, in turns, and prints medians
and ratios. Absolute times depend on the machine and its load; ratios carry over to other machines.
"""

import importlib
import sys

from absl import flags

from jaxcloseup.app.cli.start import start


SUITES = (
    *("nerf", "ngp", "warp", "labels", "splats", "native", "steps", "sweep"),
    *("resume", "detail", "scales", "teach", "gpu"),
)

_SUITE = flags.DEFINE_list("suite", ["nerf", "warp"], f"suites to run: {', '.join(SUITES)}")


def main(_: list[str]) -> None:
    """Run the suites in the order given."""
    for suite in _SUITE.value:
        importlib.import_module(f"experiments.benchmarks.{suite}").run()


@flags.multi_flags_validator(["suite"], message=f"--suite takes names from {', '.join(SUITES)}")
def _known(values: dict[str, list[str]]) -> bool:
    return bool(values["suite"]) and set(values["suite"]) <= set(SUITES)


if __name__ == "__main__":
    start(sys.modules[__name__])
