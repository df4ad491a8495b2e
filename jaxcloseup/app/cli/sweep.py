"""Arms of an ablation, over seeds, trained as one vmapped program.

    jaxcloseup sweep --scenes=table,room --seeds=3

Stage 1 is trained once for each seed and copied to every arm; arms of a seed draw the same random
numbers, so that they differ by their settings alone. Interrupted, the same command with --resume
goes on to the same tables. With --methods every method is swept on every scene, each in a process
of its own, and one table has them all.
"""

import contextlib
import os
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from absl import flags

from jaxcloseup.app.cli.flags import (
    TRAINING,
    checked_from_flags,
    load_options_from_flags,
    names_from_flags,
    preset_from_flags,
)
from jaxcloseup.app.cli.invocation import program_command, program_name
from jaxcloseup.app.cli.output_folder import choose_output_dir, lock_output_dir, prepare_to_stop
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share, topic
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.run.stage_names import ARMS


if TYPE_CHECKING:
    from jaxcloseup.app.methods.method import Preset
    from jaxcloseup.photos.scene import Scene

FLAGS = flags.FLAGS
share(TRAINING)
flags.DEFINE_list("scenes", ["table"], "built-in scenes or folders")
flags.DEFINE_list("methods", [], "sweep these methods, one after another; default: --method")
flags.DEFINE_integer("seeds", 3, "random seeds 0, 1, ...", lower_bound=1)
flags.DEFINE_list(
    "arms",
    list(ARMS),
    "arms: baseline, control, labels (no mask, four poses), mask, diverse (the preset's), oracle "
    "(true pixels of close-ups), resolved (these, as sharp as the photographs are), test_time, the "
    "preset with other settings of its labels, as in rgb_tolerance=0.02+label_loss_weight=0.5 or "
    "magnification=2:4, or both, as in mask+lr_scale=2; depth_error=0.5 halves the error of the "
    "depth that labels are made from",
)
with topic("Computers"):
    flags.DEFINE_integer(
        "max_parallel", 8, "arms and seeds trained at once, which bounds memory", lower_bound=1
    )
    flags.DEFINE_string(
        "coordinator",
        None,
        "address:port of the first of several hosts that sweep together, each started with the "
        "same flags except for --process_id, and with one --output_dir that all of them see",
    )
    flags.DEFINE_integer("num_processes", None, "how many hosts there are", lower_bound=1)
    flags.DEFINE_integer("process_id", None, "which of them this is, from 0", lower_bound=0)
# Flags that differ from process to process of `--methods`.
_EACH = ("methods", "method", "scenes", "output_dir", "resume")
_SHARED = "flags.json"  # in the folder of a sweep of methods: the others, of all its processes


def main(_: list[str]) -> None:
    """Run the sweep of the flags on every scene, for every method."""
    if FLAGS.methods:
        _sweep_methods()
    else:
        _sweep()


def _sweep() -> None:
    with loading():
        import jax

        from jaxcloseup.app import progress
        from jaxcloseup.app.report.sweep_tables import print_sweep
        from jaxcloseup.app.run.devices import HOSTS_WAIT
        from jaxcloseup.app.run.logs import check_tensorboard
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.run.plan import in_words
        from jaxcloseup.app.run.scene_input import load
        from jaxcloseup.app.score.scores import find_perceptual
        from jaxcloseup.app.store.stored_run import RunError
        from jaxcloseup.app.sweep.scene_sweeps import sweep_scenes
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    with in_one_sentence("sweep", RunError, SceneError, OSError, ValueError):
        hosts = _hosts()
        first = hosts is None or hosts[-1] == 0
        if FLAGS.tensorboard:
            check_tensorboard()
        preset = preset_from_flags()
        _check_flags(preset)
        output_dir = _output_dir(first)
        prepare_to_stop(output_dir, "sweep")
        perceptual = find_perceptual(FLAGS.lpips_weights)
        load_options = load_options_from_flags(preset)
        checked = [checked_from_flags(name, load_options) for name in FLAGS.scenes]
        scenes = [
            load(name, options) for name, (options, _) in zip(FLAGS.scenes, checked, strict=True)
        ]
        _check_scenes(scenes, preset, output_dir)
        lock = lock_output_dir(output_dir) if first else contextlib.nullcontext()
    if hosts is not None:
        # Hosts that are done wait for the first one, which writes the tables.
        jax.distributed.initialize(*hosts, shutdown_timeout_seconds=HOSTS_WAIT)
    try:
        with lock, progress.showing(words=in_words):
            found = sweep_scenes(
                scenes,
                preset,
                output_dir,
                arms=FLAGS.arms,
                seeds=FLAGS.seeds,
                names=names_from_flags(),
                load_options=load_options,
                perceptual=perceptual,
                max_parallel=FLAGS.max_parallel,
                tensorboard=FLAGS.tensorboard,
                resume=FLAGS.resume,
                first=first,
            )
    except (TrainingError, CheckpointError, SceneError, OSError) as error:
        _stop(error, alone=hosts is None)
    if first:
        print_sweep(found)
        print(f"report: {output_dir / 'report.html'}")


def _stop(error: Exception, *, alone: bool) -> None:
    """End this host with one sentence."""
    sentence = f"{program_name('sweep')}: {error}"
    if alone:
        sys.exit(sentence)
    # The others would wait for this one at the end: without it they are told to stop.
    print(sentence, file=sys.stderr, flush=True)
    os._exit(1)


def _output_dir(first: bool) -> pathlib.Path:
    """Return the output folder; the first host checks it."""
    if not first:
        return pathlib.Path(FLAGS.output_dir or "")
    return choose_output_dir(FLAGS.output_dir, "sweep", FLAGS.method, resume=FLAGS.resume)


def _hosts() -> tuple[str, int, int] | None:
    """Return the first host's address, how many there are and which this is; None for one alone."""
    hosts = FLAGS.coordinator, FLAGS.num_processes, FLAGS.process_id
    if hosts == (None, None, None):
        return None
    if None in hosts or FLAGS.process_id >= FLAGS.num_processes:
        raise ValueError(
            "several hosts need --coordinator, --num_processes and, below it, --process_id: give "
            "all three"
        )
    if FLAGS.output_dir is None:
        raise ValueError("several hosts need one folder that all of them see: give --output_dir")
    return hosts


def _check_flags(preset: "Preset") -> None:
    """Check the scenes and arms that the flags name.

    Raises:
      ValueError: one sentence that names the flag.
    """
    from jaxcloseup.app.sweep.named_arms import make_arm
    from jaxcloseup.labels.rules import LABEL_RULES, pool_label_loss

    for flag in ("scenes", "arms"):
        values = getattr(FLAGS, flag)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"--{flag}={','.join(values)} must name one or more, each once")
    train, own = preset.train, preset.labels.label_loss_weight
    # As in `closeup_step`; arms that train in turn take `labeled_step`, which adds both losses.
    pools = train.num_label_rays is not None
    pools &= LABEL_RULES[train.label_rule].loss is pool_label_loss
    for name in FLAGS.arms:
        arm = make_arm(name, preset)
        if pools and not arm.in_turn and 0 < arm.labels.label_loss_weight != own:
            raise ValueError(
                f"--arms={name}: this preset pools the losses of photographs and labels, so that "
                "only label_loss_weight=0 makes a difference"
            )
    if "control" not in FLAGS.arms:
        print("warning: without the arm control there are no gains in the tables")


def _check_scenes(captures: "Sequence[Scene]", preset: "Preset", output_dir: pathlib.Path) -> None:
    from jaxcloseup.app.run.manifest import NAME as MANIFEST
    from jaxcloseup.app.store.stored_run import read_fields
    from jaxcloseup.app.sweep.named_arms import check_possible

    names = {scene.name for scene in captures}
    if len(names) < len(captures):
        raise ValueError(f"{_given_scenes()} has two of one name: sweep them one at a time")
    check_possible(FLAGS.arms, preset, captures)
    kept = output_dir / MANIFEST
    if FLAGS.resume and kept.exists():
        before = read_fields(kept, {"scenes": dict})["scenes"]
        if set(before) != names:
            raise ValueError(
                f"{_given_scenes()} are not those of {output_dir}, {','.join(before)}: resume it "
                "as it was begun"
            )


def _sweep_methods() -> None:
    """Sweep the methods of `--methods`; what an interrupted sweep has finished stays."""
    with loading():
        from jaxcloseup.app.sweep.method_sweeps import sweep_methods
    methods = FLAGS.methods
    with in_one_sentence("sweep", OSError, ValueError):
        unknown = [name for name in methods if name not in METHODS]
        if unknown or len(set(methods)) < len(methods):
            raise ValueError(
                f"--methods={','.join(methods)} must name some of {', '.join(METHODS)}, each once"
            )
        for method in methods:
            FLAGS.method = method
            _check_flags(preset_from_flags())
        if FLAGS.coordinator is not None:
            raise ValueError("--methods sweeps on one host: leave out --coordinator")
        scenes = {os.path.basename(os.path.realpath(scene)): scene for scene in FLAGS.scenes}
        if len(scenes) < len(FLAGS.scenes):
            raise ValueError(f"{_given_scenes()} has two of one name: sweep them one at a time")
        folder = choose_output_dir(
            FLAGS.output_dir, "sweep", "methods", resume=FLAGS.resume, kept=_SHARED
        )
        prepare_to_stop(folder, "sweep", kept=_SHARED)
        lock = lock_output_dir(folder)
    with lock:
        with in_one_sentence("sweep", OSError, ValueError):
            _keep_flags(folder)
        failed = sweep_methods(folder, methods, scenes, _command())
    if failed:
        reason = f"left out, for the reasons above: {', '.join(failed)}"
        sys.exit(f"{program_name('sweep')}: {reason}")
    print(f"tables: {folder / 'methods.md'}")


def _given_scenes() -> str:
    return f"--scenes={','.join(FLAGS.scenes)}"


def _keep_flags(folder: pathlib.Path) -> None:
    """Keep the flags that all methods share; refuse to resume a sweep of methods with others."""
    from jaxcloseup.io.files import read_object, write_json

    cache = "--compilation_cache="  # changes no result
    shared = [flag for flag in _shared_flags() if not flag.startswith(cache)]
    kept, flags = folder / _SHARED, {"flags": sorted(shared)}
    if FLAGS.resume and kept.exists() and read_object(kept) != flags:
        before = " ".join(read_object(kept)["flags"]) or "no flags"
        raise ValueError(f"{folder} was begun with {before}: resume it as it was begun")
    write_json(kept, flags)


def _shared_flags() -> list[str]:
    """Return the flags of this program that were given and that all methods share."""
    given = [flag for flag in FLAGS.get_key_flags_for_module(__name__) if flag.present]
    shared = "\n".join(flag.serialize() for flag in given if flag.name not in _EACH)
    return shared.split("\n") if shared else []


def _command() -> list[str]:
    """Return words that start a sweep with the flags that all methods share."""
    words = program_command("sweep")
    start = words[1:] if words[0] == "python" else ["-m", *words]
    return [sys.executable, *start, *_shared_flags()]
