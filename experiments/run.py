"""Train, fine-tune on pseudo-labeled close-ups, evaluate, report.

    python -m experiments.run --scene=table

Stages: `baseline` trains on the photographs; `control` and `closeup` both go on from it for the
same number of steps, without and with pseudo-labels of random close-ups; `test_time` goes on from
it with labels of the very close-ups that are scored. The scene is a built-in one or a folder.
"""

import sys

from absl import app, flags

from experiments.command_line import make, set_up
from experiments.evaluation.scores import find_perceptual
from experiments.reporting.report import print_table
from experiments.training import flags as training_flags
from experiments.training.logs import check_tensorboard
from experiments.training.loop import TrainingError
from experiments.training.stages import STAGES, run
from jaxcloseup.artifacts.checkpoints import CheckpointError
from jaxcloseup.scenes import SceneError


FLAGS = flags.FLAGS
flags.adopt_module_key_flags(training_flags)  # these are in --help too
for _name in ("output_dir", "lpips_weights", "compilation_cache"):
    flags.declare_key_flag(_name)
flags.DEFINE_string(
    "scene", "table", "a built-in scene (counter, table, room, bench, stairs) or a folder"
)
flags.DEFINE_integer("seed", 0, "random seed; the same seed gives the same metrics", lower_bound=0)
flags.DEFINE_integer(
    "save_every", 1000, "steps between checkpoints; each stage's end is kept too", lower_bound=1
)
flags.DEFINE_list("stages", list(STAGES), "of the stages those to run; baseline always is")


def main(argv: list[str]) -> None:
    """Run all stages with the settings of the flags."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument: {argv[1]}")
    set_up()
    try:
        if FLAGS.tensorboard:
            check_tensorboard()
        preset = training_flags.preset_from_flags()
        output_dir = training_flags.choose_output_dir(
            FLAGS.output_dir, FLAGS.scene, FLAGS.method, resume=FLAGS.resume
        )
        load_options = training_flags.load_options_from_flags(preset)
        scene = training_flags.load(FLAGS.scene, load_options)
        perceptual = find_perceptual(FLAGS.lpips_weights)
        make(output_dir)
    except (SceneError, OSError, ValueError) as error:
        sys.exit(f"experiments.run: {error}")
    try:
        results = run(
            scene,
            preset,
            FLAGS.seed,
            output_dir,
            names=training_flags.names_from_flags(),
            to_run=FLAGS.stages,
            save_every=FLAGS.save_every,
            perceptual=perceptual,
            load_options=load_options,
            tensorboard=FLAGS.tensorboard,
        )
    except (TrainingError, CheckpointError, OSError) as error:
        sys.exit(f"experiments.run: {error}")
    print_table(results)
    print(f"report: {output_dir / 'report.html'}")


@flags.multi_flags_validator(["stages"], message=f"--stages takes names of {', '.join(STAGES)}")
def _known(values: dict[str, list[str]]) -> bool:
    return set(values["stages"]) <= set(STAGES)


if __name__ == "__main__":
    app.run(main)
