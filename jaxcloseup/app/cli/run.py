"""Train, fine-tune on pseudo-labeled close-ups, evaluate, report.

    python -m experiments.run --scene=table

Stages: `baseline` trains on the photographs; `control` and `closeup` both continue from it for the
same number of steps, without and with pseudo-labels of random close-ups; `detail` adds to renders
what the photographs show beyond them; `test_time` learns labels of the very close-ups that are
scored. The scene is a built-in one or a folder.
"""

from absl import flags

from jaxcloseup.app.cli import training_flags as define_flags
from jaxcloseup.app.cli.start import job
from jaxcloseup.app.run.stage_names import STAGES


flags.adopt_module_key_flags(define_flags)  # these are in --help too
for _name in ("output_dir", "lpips_weights", "compilation_cache"):
    flags.declare_key_flag(_name)
flags.DEFINE_string(
    "scene", "table", "a built-in scene (counter, table, room, bench, stairs) or a folder"
)
flags.DEFINE_integer(
    "seed",
    0,
    "random seed; the same seed gives the same metrics",
    lower_bound=0,
    upper_bound=2**63 - 1,
)
flags.DEFINE_integer(
    "save_every", 1000, "steps between checkpoints; each stage's end is kept too", lower_bound=1
)
flags.DEFINE_list("stages", list(STAGES), "stages to run; baseline always runs")


def main(_: list[str]) -> None:
    """Run all stages with the settings of the flags."""
    job("run").main()


@flags.multi_flags_validator(["stages"], message=f"--stages takes names of {', '.join(STAGES)}")
def _known(values: dict[str, list[str]]) -> bool:
    return set(values["stages"]) <= set(STAGES)
