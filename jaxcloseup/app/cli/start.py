"""Start a program: flags, `--help`, errors in one sentence, and setup of the process."""

import contextlib
import logging
import math
import os
import pathlib
import re
import sys
import types
import warnings
from collections.abc import Iterator

from absl import app, flags

from jaxcloseup.app import progress
from jaxcloseup.app.cli.invocation import program_name
from jaxcloseup.app.cli.topics import describe_flag, flags_by_topic
from jaxcloseup.io.files import cache_folder
from jaxcloseup.io.memory import reuse_freed_memory
from jaxcloseup.io.messages import describe_option, printable


FLAGS = flags.FLAGS
# Of XLA on a CPU: the widest vectors that there are, and no unrolling of loops, which are short.
_COMPILED_FOR_SPEED = (
    "--xla_cpu_prefer_vector_width=512 --xla_backend_extra_options=xla_cpu_disable_loop_unrolling"
)


def start(program: types.ModuleType) -> None:
    """Run a program's module; `--help` prints its flags, and a wrong flag is one sentence.

    A module with `OPERANDS`, the number of words that are no flags, gets these words in `main`.
    """
    if {"-h", "--help"} & set(sys.argv[1:]):
        with contextlib.suppress(BrokenPipeError):  # `--help | head`
            print(_describe_program(program), flush=True)
        os._exit(0)
    reuse_freed_memory()
    os.environ["XLA_FLAGS"] = " ".join([_COMPILED_FOR_SPEED, os.environ.get("XLA_FLAGS", "")])
    # For each kept program XLA writes an error where names of instructions differ that are its own.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    name = program_name(pathlib.Path(program.__file__ or "").stem)

    def parse(words: list[str]) -> list[str]:
        try:
            rest = FLAGS(words)
        except flags.Error as error:
            reason = _explain(error)
        else:
            if len(rest) > 1 + getattr(program, "OPERANDS", 0):
                reason = f"{rest[-1]} is not a flag: flags begin with --"
            elif endless := _endless():
                reason = endless
            else:
                return rest
        sys.exit(f"{name}: {reason}")

    app.run(program.main, flags_parser=parse)


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Show that a program imports what takes seconds, and keep libraries' notes to themselves."""
    # Notes about missing accelerators, new fonts, every file of a checkpoint, and repeats of what
    # the program prints do not concern the user. Some are written during imports.
    for noisy in ("jax._src.xla_bridge", "matplotlib", "jaxcloseup"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    # Orbax logs errors with a traceback, and raises them too.
    logging.getLogger("absl").setLevel(logging.CRITICAL)
    with progress.showing():
        yield


@contextlib.contextmanager
def in_one_sentence(program: str, *errors: type[Exception]) -> Iterator[None]:
    """End the program with one sentence, which begins with its name, at any of these errors."""
    try:
        yield
    except errors as error:
        sys.exit(f"{program_name(program)}: {_sentence(error)}")


def _sentence(error: Exception) -> str:
    """Return what an error says; of one that the system raised, with what to do."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        file = printable(os.fsdecode(error.filename))
        return (
            f"{file} cannot be read or written ({error.strerror}): name another place, or change "
            "its permissions"
        )
    return str(error)


def _endless() -> str | None:
    """Return what is wrong with a flag whose number is infinite or none; None without one."""
    for name in FLAGS:
        flag = FLAGS[name]
        if isinstance(flag.value, float) and not math.isfinite(flag.value):
            return f"--{name}={flag.value} must be {_wanted(flag.parser)}"
    return None


def _explain(error: flags.Error) -> str:
    """Return what is wrong with a flag, beginning with its name."""
    text = " ".join(str(error).split())
    if isinstance(error, flags.UnrecognizedFlagError):
        found = re.search(r"Did you mean: (.*) \?$", text)
        meant = f"perhaps --{found[1].replace(', ', ' or --')} is meant; " if found else ""
        return f"--{error.flagname} is not a flag: {meant}--help lists all flags"
    if found := re.match(r"Missing value for flag (\S+)", text):
        return f"{found[1]} needs a value"
    if found := re.match(r"flag --(\w+)=(.*?): ", text):
        return f"--{found[1]}={found[2]} must be {_wanted(FLAGS[found[1]].parser)}"
    return re.sub(r"^flags? .*?: (?=--)", "", text)  # of a validator


def _wanted(parser: flags.ArgumentParser) -> str:
    """Return what a flag's parser takes, in words."""
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


def _describe_program(program: types.ModuleType) -> str:
    """Return what the program does, and its flags by topic."""
    module = sys.argv[0] if program.__name__ == "__main__" else program.__name__
    lines = [(program.__doc__ or "").strip()]
    for topic, found in flags_by_topic(FLAGS.get_key_flags_for_module(module)).items():
        lines += ["", f"{topic}:", *map(_describe_flag, found)]
    return "\n".join(lines)


def _describe_flag(flag: flags.Flag) -> str:
    if flag.boolean:
        shown = f"--[no]{flag.name}"
    else:
        values = flag.default if isinstance(flag.default, list) else [flag.default]
        shown = f"--{flag.name}=" + ",".join("..." if v is None else str(v) for v in values)
    text = describe_flag(flag)
    choices = getattr(flag.parser, "enum_values", ())
    if not all(choice in text for choice in choices):
        text += f"; one of {', '.join(choices)}"
    if flag.boolean and flag.default:
        text += "; on by default"
    return describe_option(shown, text)


def set_up() -> None:
    """Set up the compilation cache, and the form of warnings."""
    with contextlib.suppress(AttributeError):  # not a file
        # Also where a file or a pipe is read along.
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    set_up_compilation_cache(FLAGS.compilation_cache)
    # The program's own warnings are sentences for the user.
    warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)


def set_up_compilation_cache(folder: str | None) -> None:
    """Keep compiled programs on disk, so that the next run starts faster.

    None takes the default folder; an empty name turns the cache off.
    """
    if folder is None:
        folder = str(cache_folder() / "jaxcloseup" / "xla")
    if folder:
        import jax  # not before the flags are read

        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
