"""Flags and setup that the programs share."""

import contextlib
import difflib
import importlib
import logging
import os
import pathlib
import re
import shlex
import shutil
import sys
import textwrap
import types
import warnings
from typing import Any

from absl import app, flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli.interrupt import when_stopped
from jaxcloseup.io.files import cache_folder
from jaxcloseup.io.memory import reuse_freed_memory


try:
    import fcntl
except ImportError:  # not a Unix: nothing is locked
    fcntl = None


LOCK = ".lock"  # in a folder that a program trains in
CHECKPOINTS = "checkpoints"  # its folder that can be resumed from
FLAGS = flags.FLAGS
_program: types.ModuleType  # that runs
flags.DEFINE_string(
    "lpips_weights",
    None,
    "folder of LPIPS weights: vgg16-*.pth with vgg.pth, or alexnet-*.pth with alex.pth; "
    "default: $JAXCLOSEUP_LPIPS, or PyTorch's cache",
)
flags.DEFINE_string(
    "compilation_cache",
    None,
    "folder that keeps compiled programs between runs; empty: no cache; default: under ~/.cache",
)
flags.DEFINE_string(
    "output_dir",
    None,
    "folder for results, new or empty; default: outputs/<scene>/<method>/<date_time> of a run, "
    "<run>/videos/<date_time> of render, <run>/meshes/<date_time> of mesh, and "
    "outputs/compare/<date_time> of compare; process needs one",
)

# Of XLA on a CPU: the widest vectors that there are, and no unrolling of loops, which are short.
_COMPILED_FOR_SPEED = (
    "--xla_cpu_prefer_vector_width=512 --xla_backend_extra_options=xla_cpu_disable_loop_unrolling"
)
_TOPICS = {
    "What is trained": "scene scenes method methods preset set stages arms seed seeds downscale "
    "windows",
    "The capture": "format split zoom photographs half_pixel invert_masks alpha_mode",
    "The run": "run stage data",
    "Cameras": "views camera_path camera_transform target orbit from pixel magnification up frames "
    "width height",
    "Pictures": "fine_tune target_steps detail support fps",
    "Results": "output_dir output resume save_every tensorboard",
    "Computers": "host port max_parallel coordinator num_processes process_id compilation_cache "
    "lpips_weights",
}


def start(program: types.ModuleType) -> None:
    """Run a program; `--help` and `-h` print its flags, and a wrong flag or word is one sentence.

    Args:
      program: its module: flags, docstring and `main`. What needs JAX is in its `job`.
    """
    global _program
    _program = program
    if {"-h", "--help"} & set(sys.argv[1:]):
        with contextlib.suppress(BrokenPipeError):  # `--help | head`
            print(_describe_program(), flush=True)
        os._exit(0)
    reuse_freed_memory()
    os.environ["XLA_FLAGS"] = " ".join([_COMPILED_FOR_SPEED, os.environ.get("XLA_FLAGS", "")])
    app.run(program.main, flags_parser=_parse)


def job(name: str) -> types.ModuleType:
    """The module of `jaxcloseup.app.jobs` with this name; what it imports takes seconds."""
    # Notes about missing accelerators, new fonts, every file of a checkpoint, and repeats of what
    # the program prints do not concern the user. Some are written during imports.
    for noisy in ("jax._src.xla_bridge", "matplotlib", "jaxcloseup"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    # Orbax logs errors with a traceback, and raises them too.
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    with progress.showing():
        return importlib.import_module(f"jaxcloseup.app.jobs.{name}")


def _parse(words):
    """Set the flags; what is wrong with them is one sentence."""
    try:
        rest = FLAGS(words)
    except flags.Error as error:
        reason = _explain(error)
    else:
        if len(rest) == 1:
            return rest
        reason = f"{rest[1]} is not a flag: flags begin with --"
    name = pathlib.Path(_program.__file__ or "").stem
    sys.exit(f"experiments.{name}: {reason}")


def _explain(error):
    """What is wrong with a flag, beginning with its name."""
    text = " ".join(str(error).split())
    if isinstance(error, flags.UnrecognizedFlagError):
        near = difflib.get_close_matches(error.flagname, _own_flags(), n=1)
        meant = "".join(f"perhaps --{name} is meant; " for name in near)
        return f"--{error.flagname} is not a flag: {meant}--help lists all flags"
    if found := re.match(r"Missing value for flag (\S+)", text):
        return f"{found[1]} needs a value"
    if found := re.match(r"flag --(\w+)=(.*?): ", text):
        return f"--{found[1]}={found[2]} must be {_wanted(FLAGS[found[1]].parser)}"
    return re.sub(r"^flags? .*?: (?=--)", "", text)  # of a validator


def _wanted(parser):
    """What a flag's parser takes, in words."""
    if choices := getattr(parser, "enum_values", None):
        return f"one of {', '.join(choices)}"
    if isinstance(parser, flags.BooleanParser):
        return "true or false"
    if not isinstance(parser, flags.IntegerParser | flags.FloatParser):
        return parser.syntactic_help
    kind = "a whole number" if isinstance(parser, flags.IntegerParser) else "a number"
    low, high = parser.lower_bound, parser.upper_bound
    if low is None:
        return kind
    return f"{kind} of at least {low}" if high is None else f"{kind} between {low} and {high}"


def _own_flags():
    """The flags of the program that runs, by name."""
    module = sys.argv[0] if _program.__name__ == "__main__" else _program.__name__
    return {flag.name: flag for flag in FLAGS.get_key_flags_for_module(module)}


def _describe_program():
    """What the program does, and its flags by topic."""
    found = _own_flags()
    topics = {topic: [n for n in names.split() if n in found] for topic, names in _TOPICS.items()}
    others = sorted(set(found).difference(*topics.values()))
    lines = [(_program.__doc__ or "").strip()]
    for topic, names in ({"Its own flags": others} | topics).items():
        if names:
            lines += ["", f"{topic}:", *(_describe_flag(found[name]) for name in names)]
    return "\n".join(lines)


def _describe_flag(flag):
    width = min(max(shutil.get_terminal_size().columns, 60), 100)
    if flag.boolean:
        shown = f"--[no]{flag.name}"
    else:
        values = flag.default if isinstance(flag.default, list) else [flag.default]
        shown = f"--{flag.name}=" + ",".join("..." if one is None else str(one) for one in values)
    text = re.sub(r"^<.*?>: |;\s+repeat this option .*", "", flag.help)  # as absl says it
    choices = getattr(flag.parser, "enum_values", ())
    if not all(choice in text for choice in choices):
        text += f"; one of {', '.join(choices)}"
    if flag.boolean and flag.default:
        text += "; on by default"
    left = " " * 26
    wrapped = textwrap.fill(text, width, initial_indent=left, subsequent_indent=left)
    first = f"  {shown}"
    return first + wrapped[len(first) :] if len(first) < len(left) - 1 else f"{first}\n{wrapped}"


def set_up() -> None:
    """Set up the compilation cache, and the form of warnings."""
    with contextlib.suppress(AttributeError):  # not a file
        sys.stdout.reconfigure(line_buffering=True)  # also where a file or a pipe is read along
    set_up_compilation_cache(FLAGS.compilation_cache)
    # The program's own warnings are sentences for the user.
    warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)


def set_up_compilation_cache(folder: str | None) -> None:
    """Keep compiled programs on disk, so that the next run starts faster.

    Args:
      folder: cache folder; None for the default one, empty for no cache.
    """
    if folder is None:
        folder = str(cache_folder() / "jaxcloseup" / "xla")
    if folder:
        import jax  # not before the flags are read

        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def check_unused(folder: str | pathlib.Path) -> pathlib.Path:
    """Return the path of an output folder, which must be empty or not exist yet.

    Raises:
      FileExistsError: the folder holds files, or the path is a file.
    """
    path = pathlib.Path(folder)
    if path.exists() and (not path.is_dir() or any(one.name != LOCK for one in path.iterdir())):
        raise FileExistsError(
            f"--output_dir={folder} already exists and is not empty: name a new folder, or remove "
            "it first"
        )
    return path


def lock_output_dir(folder: pathlib.Path) -> contextlib.AbstractContextManager[Any]:
    """Create the output folder, and keep other processes from training in it.

    Returns:
      A context, which holds the lock until it is left or the process ends, in whatever way. Where
      files cannot be locked it holds nothing.

    Raises:
      OSError: the folder cannot be created or written, or another process trains in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("a+")
    except OSError as error:
        raise OSError(
            f"--output_dir={folder} cannot be created or written ({error.strerror}): name a folder "
            "where you may write"
        ) from error
    if fcntl is None:
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            file.seek(0)
            holder = file.read(20).strip() or "unknown"
        raise OSError(
            f"--output_dir={folder} is in use by the process {holder}: wait until it ends, or name "
            "another folder"
        ) from None
    except OSError:  # a file system without locks
        return file
    with contextlib.suppress(OSError):  # on a full disk the lock holds too
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
    return file


def prepare_to_stop(folder: pathlib.Path, program: str | None = None) -> None:
    """Let Ctrl-C remove unfinished files from an output folder, and print how to resume.

    Args:
      folder: the output folder.
      program: name of a program that resumes training in it; None cannot be resumed.
    """
    arguments = sys.argv[1:]
    if FLAGS.output_dir is None:
        arguments += [f"--output_dir={folder}"]

    def say():
        for part in folder.rglob(f".*.{os.getpid()}.part*"):
            part.unlink(missing_ok=True)
        if program is None:
            return "stopped"
        if not (folder / CHECKPOINTS).is_dir():
            return "stopped before training began: give the same command again"
        resume = [] if "--resume" in arguments else ["--resume"]
        command = shlex.join(["python", "-m", program, *arguments, *resume])
        return f"stopped: resume it with {command}"

    when_stopped(say)
