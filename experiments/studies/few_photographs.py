"""Table of fields that learn from 20 of the 60 photographs of each drawn scene.

python -m experiments.studies.few_photographs

makes the runs in `outputs/studies`, unless they are there, and prints the table. `--runs` and
`--all_runs` name folders of finished runs instead.
"""

import pathlib
from collections.abc import Mapping

from absl import app, flags

from experiments.studies.tables import (
    CLOSEUPS,
    ORDINARY,
    SCENES,
    Results,
    finished_runs,
    format_gain,
    format_mean_gain,
    gains,
    pair,
    print_table,
)


FLAGS = flags.FLAGS
_GIVEN = ("--stages=control,detail", "--score_width=120")


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", [], "folders of runs with few photographs, one for each scene")
    flags.DEFINE_list("all_runs", [], "folders of the same runs with all photographs")
    flags.DEFINE_list("scenes", SCENES, "drawn scenes, where runs are made")
    flags.DEFINE_integer("photographs", 20, "number of photographs", lower_bound=2)
    flags.DEFINE_string("output_dir", "outputs/studies", "folder of the runs to make")


def main(_: list[str]) -> None:
    """Print the table of the runs."""
    root, count = pathlib.Path(FLAGS.output_dir), FLAGS.photographs
    given = (*_GIVEN, f"--photographs={count}")
    few = finished_runs(FLAGS.runs, root / f"photographs_{count}", FLAGS.scenes, *given)
    whole: dict[str, Results] = {}
    if FLAGS.all_runs or not FLAGS.runs:
        whole = finished_runs(FLAGS.all_runs, root / "photographs_all", FLAGS.scenes, *_GIVEN)
    print_photographs(few, whole, f"{count} photographs")


def print_photographs(few: Mapping[str, Results], whole: Mapping[str, Results], title: str) -> None:
    """Print the gain of detail in each scene, beside the scores with all photographs."""
    rows: list[list[str]] = []
    by_split: dict[str, list[list[float]]] = {CLOSEUPS: [], ORDINARY: []}
    for name, results in few.items():
        row = [name]
        for stage in ("control", "detail"):
            row.append(" / ".join(pair(results, [stage], split) for split in by_split))
        for split, found in by_split.items():
            found.append(gains(results, split, "detail", "control"))
            row.append(format_gain(found[-1]))
        both = ("control", "detail")
        rows.append([*row, pair(whole[name], both, CLOSEUPS) if name in whole else "-"])
    header = ["scene", "`control`", "with detail", "gain on close-ups (95 %)", "on ordinary views"]
    header.append("close-ups with all: `control` / with detail")
    print_table(title, header, rows)
    means = (format_mean_gain(found) for found in by_split.values())
    print("mean gain on close-ups and on ordinary views: " + ", ".join(means))


if __name__ == "__main__":
    define_flags()
    app.run(main)
