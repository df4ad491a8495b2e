"""Arms of an ablation, over seeds, trained as one vmapped program.

    python -m experiments.sweep --scenes=table,room --seeds=3

Stage 1 is trained once for each seed and copied to every arm; arms of a seed draw the same random
numbers, so that they differ by their settings alone. Interrupted, the same command with --resume
goes on to the same tables. With --methods every method is swept on every scene, each in a process
of its own, and one table has them all.
"""

from absl import flags

from jaxcloseup.app.cli import training_flags as define_flags
from jaxcloseup.app.cli.start import job
from jaxcloseup.app.run.stage_names import ARMS


FLAGS = flags.FLAGS
flags.adopt_module_key_flags(define_flags)  # these are in --help too
for _name in ("output_dir", "lpips_weights", "compilation_cache"):
    flags.declare_key_flag(_name)
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
flags.DEFINE_integer(
    "max_parallel", 8, "arms and seeds trained at once, which bounds memory", lower_bound=1
)
flags.DEFINE_string(
    "coordinator",
    None,
    "address:port of the first of several hosts that sweep together, each started with the same "
    "flags but for --process_id, and with one --output_dir that all of them see",
)
flags.DEFINE_integer("num_processes", None, "how many hosts there are", lower_bound=1)
flags.DEFINE_integer("process_id", None, "which of them this is, from 0", lower_bound=0)


def main(_: list[str]) -> None:
    """Run the sweep of the flags on every scene, for every method."""
    job("sweep_methods" if FLAGS.methods else "sweep").main()
