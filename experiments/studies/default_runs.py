"""Tables of default runs: "A default run" of docs/results.md.

    python -m experiments.studies.default_runs --capture=path/to/plush

makes the runs in `outputs/studies`, unless they are there, and prints the tables. `--runs` names
folders of finished runs instead.
"""

import pathlib
from collections.abc import Mapping

from absl import app, flags

from experiments.studies.tables import (
    CLOSEUPS,
    ORDINARY,
    SCENES,
    TITLES,
    Results,
    field_and_detail,
    finished_runs,
    format_gain,
    format_mean_gain,
    gains,
    pair,
    print_table,
    score,
)
from jaxcloseup.app.report.headline import used_labels
from jaxcloseup.app.score.metrics_text import REDUCED


FLAGS = flags.FLAGS
_RUNGS = (1, 2, 4, 8, 16)


def define_flags() -> None:
    """Define the flags of the script, whose names other scripts use too."""
    flags.DEFINE_list("runs", [], "folders of default runs, one for each scene")
    flags.DEFINE_list("scenes", SCENES, "drawn scenes, where runs are made")
    flags.DEFINE_string("capture", None, "folder of a real capture, where runs are made")
    flags.DEFINE_string("output_dir", "outputs/studies", "folder of the runs to make")


def main(_: list[str]) -> None:
    """Print the tables of the runs."""
    scenes = [*FLAGS.scenes, *filter(None, [FLAGS.capture])]
    root = pathlib.Path(FLAGS.output_dir)
    runs = finished_runs(FLAGS.runs, root / "default", scenes)
    print_all(runs)


def print_all(runs: Mapping[str, Results]) -> None:
    """Print all tables of runs by scene."""
    print_default(runs)
    print_magnifications(runs)
    print_labels(runs)


def print_default(runs: Mapping[str, Results]) -> None:
    """Print the gain of detail in each scene and split, and its mean over the drawn scenes."""
    rows = []
    for name, results in runs.items():
        both = field_and_detail(results)
        for split in filter(results["stages"]["detail"].__contains__, TITLES):
            gained = gains(results, split, *both[::-1])
            row = [f"{name}, {TITLES[split]}", pair(results, both[:1], split)]
            row += [f"**{pair(results, both[1:], split)}**", format_gain(gained)]
            row += [f"{min(gained):+.2f}", pair(results, both, split, "cc_psnr")]
            row += [
                pair(results, both, split, "resolves", 1),
                pair(results, both, split, "ssim", 3),
            ]
            row.append(pair(results, both, split + REDUCED))
            rows.append(row)
    header = ["scene, views", "field", "with detail", "gain (95 %)", "worst view"]
    header += ["color-corrected", "resolves (px)", "SSIM", "at the size of training"]
    print_table("A default run", header, rows)
    for split, title in TITLES.items():
        drawn = [
            gains(r, split, *field_and_detail(r)[::-1])
            for name, r in runs.items()
            if name in SCENES
        ]
        if drawn:
            print(f"mean of drawn scenes, {title}: {format_mean_gain(drawn)} dB")
    print()


def print_magnifications(runs: Mapping[str, Results]) -> None:
    """Print PSNR on the zoom ladder, of the scenes that have one."""
    rows = [
        [
            name,
            *(
                pair(results, field_and_detail(results), f"zoom_{times}", digits=1)
                for times in _RUNGS
            ),
        ]
        for name, results in runs.items()
        if score(results, "detail", "zoom_1") is not None
    ]
    print_table("By magnification", ["scene", *(f"{times}x" for times in _RUNGS)], rows)


def print_labels(runs: Mapping[str, Results]) -> None:
    """Print the gains of pseudo-labels over as many steps without, where the runs have both."""
    rows = []
    for name, results in runs.items():
        if not {"closeup", "test_time", "test_time_control"} <= set(results["stages"]):
            continue
        if not used_labels(results):
            row = [name, "the gate admits no labels", ""]
        else:
            gained, far = (gains(results, s, "closeup", "control") for s in (CLOSEUPS, ORDINARY))
            row = [name, format_gain(gained, 3), f"{sum(far) / len(far):+.3f}"]
        stages = ("test_time", "test_time_control")
        tuned, far = (gains(results, split, *stages) for split in (CLOSEUPS, ORDINARY))
        row += [pair(results, ["test_time_control"], CLOSEUPS)]
        row += [f"**{pair(results, ['test_time'], CLOSEUPS)}**", format_gain(tuned)]
        rows.append([*row, f"{sum(far) / len(far):+.2f}"])
    header = ["scene", "closeup - control: close-ups", "ordinary", "test_time_control"]
    print_table("What labels gain", [*header, "test_time", "gain (95 %)", "ordinary"], rows)


if __name__ == "__main__":
    define_flags()
    app.run(main)
