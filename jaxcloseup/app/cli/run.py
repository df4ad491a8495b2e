"""Train, fine-tune on pseudo-labeled close-ups, evaluate, report.

    jaxcloseup run --scene=table

Stages: `baseline` trains on the photographs; `control` and `closeup` both continue from it for the
same number of steps, without and with pseudo-labels of random close-ups; `detail` adds to renders
what the photographs show beyond them; `test_time` learns labels of the very close-ups that are
scored. The scene is a built-in one or a folder.
"""

import pathlib
import shlex
from typing import TYPE_CHECKING

from absl import flags

from jaxcloseup.app.cli.flags import (
    TIME,
    TRAINING,
    checked_from_flags,
    load_options_from_flags,
    names_from_flags,
    preset_from_flags,
    settings_from_flags,
)
from jaxcloseup.app.cli.output_folder import (
    CHECKPOINTS,
    choose_output_dir,
    lock_output_dir,
    prepare_to_stop,
)
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share
from jaxcloseup.app.methods.method import Preset
from jaxcloseup.app.methods.settings import with_settings
from jaxcloseup.app.run.stage_names import STAGES


if TYPE_CHECKING:
    from jaxcloseup.app.run.read_photographs import ReadPhotographs
    from jaxcloseup.photos.scene import Scene

FLAGS = flags.FLAGS
share(TRAINING, TIME)
flags.DEFINE_string(
    "scene", "table", "a built-in scene (counter, table, room, bench, stairs, statue) or a folder"
)
flags.DEFINE_integer(
    "seed",
    0,
    "random seed; the same seed gives the same metrics",
    lower_bound=0,
    upper_bound=2**32 - 1,  # of which JAX makes keys
)
flags.DEFINE_integer(
    "save_every", 1000, "steps between checkpoints; each stage's end is kept too", lower_bound=1
)
flags.DEFINE_list("stages", list(STAGES), "stages to run; baseline always runs")


def main(_: list[str]) -> None:
    """Run all stages with the settings of the flags."""
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.report.headline import print_results
        from jaxcloseup.app.report.reported_run import run
        from jaxcloseup.app.run.logs import check_tensorboard
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.run.scene_input import load
        from jaxcloseup.app.score.scores import find_perceptual
        from jaxcloseup.app.store.stored_run import RunError
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    with in_one_sentence("run", SceneError, RunError, OSError, ValueError):
        if FLAGS.tensorboard:
            check_tensorboard()
        preset = preset_from_flags()
        output_dir = choose_output_dir(
            FLAGS.output_dir, FLAGS.scene, FLAGS.method, resume=FLAGS.resume
        )
        prepare_to_stop(output_dir, "run")
        load_options = load_options_from_flags(preset)
        with progress.showing():
            load_options, found = checked_from_flags(FLAGS.scene, load_options)
            with progress.saying(f"loading {FLAGS.scene}"):
                scene = load(FLAGS.scene, load_options)
        scene.metadata["check"], read = found, None
        if FLAGS.minutes is not None:
            preset, read = _resumed(output_dir) if FLAGS.resume else _fitted(preset, scene)
        to_run = _stages(output_dir)
        perceptual = find_perceptual(FLAGS.lpips_weights)
        lock = lock_output_dir(output_dir)
    expected = (TrainingError, CheckpointError, SceneError, OSError)
    with in_one_sentence("run", *expected), lock, progress.showing():
        results = run(
            scene,
            preset,
            FLAGS.seed,
            output_dir,
            names=names_from_flags(),
            to_run=to_run,
            save_every=FLAGS.save_every,
            perceptual=perceptual,
            load_options=load_options,
            tensorboard=FLAGS.tensorboard,
            read=read,
        )
    print_results(results)
    print(f"report: {output_dir / 'report.html'}")


def _stages(output_dir: pathlib.Path) -> list[str]:
    """Return the stages to run: those asked for, and those that a resumed run has scored before."""
    from jaxcloseup.app.store.stored_run import read_fields

    path, scored = output_dir / "results.json", {}
    if FLAGS.resume and path.exists():
        scored = read_fields(path, {"stages": dict})["stages"]
    return [stage for stage in STAGES if stage in FLAGS.stages or stage in scored]


def _resumed(output_dir: pathlib.Path) -> "tuple[Preset, ReadPhotographs | None]":
    """Return the preset with the settings that were found when the run began."""
    from jaxcloseup.app.store.stored_config import preset_from_config
    from jaxcloseup.app.store.stored_run import read_fields

    identity = read_fields(output_dir / CHECKPOINTS / "run.json", {"config": dict})
    # Settings that were given when it began change nothing; others are refused as another run's.
    return with_settings(preset_from_config(identity["config"])[0], settings_from_flags()), None


def _fitted(preset: Preset, scene: "Scene") -> "tuple[Preset, ReadPhotographs | None]":
    """Return the preset that takes so many minutes, and what timing made of the photographs."""
    from jaxcloseup.app import progress
    from jaxcloseup.app.run.minutes import fit_minutes

    asked = settings_from_flags()
    fixed = {text.partition("=")[0] for text in asked}
    with progress.showing(), progress.saying("timing steps"):
        fitted = fit_minutes(preset, scene, FLAGS.minutes, fixed=fixed)
    repeat = shlex.join(f"--set={text}" for text in [*asked, *fitted.given])
    print(f"{FLAGS.minutes:g} minutes of training, as {repeat} repeats it")
    return fitted.preset, fitted.read


@flags.multi_flags_validator(["stages"], message=f"--stages takes names of {', '.join(STAGES)}")
def _known(values: dict[str, list[str]]) -> bool:
    return set(values["stages"]) <= set(STAGES)
