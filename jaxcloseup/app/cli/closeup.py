"""Look closer: from photographs, a video, a capture or a run to close-ups and a page to send.

    jaxcloseup closeup photographs
    jaxcloseup closeup photographs --at=IMG_0003:2000,1300

finds poses if there are none, checks the capture, trains, renders close-ups with the photographs'
detail, and writes share/index.html, a page with the scene to turn and the close-ups pinned to it.
The same command goes on where it was stopped; with another --at it adds a close-up in seconds.
"""

import pathlib
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping

from absl import flags

from jaxcloseup.app.cli.closeup_folder import (
    MESH_BEGUN,
    begun,
    check_folder,
    check_mesh,
    check_source,
    keep,
)
from jaxcloseup.app.cli.flags import CHECK, OUTPUT, TIME
from jaxcloseup.app.cli.interrupt import when_stopped
from jaxcloseup.app.cli.invocation import program_command, program_name
from jaxcloseup.app.cli.output_folder import CHECKPOINTS, lock_output_dir, remove_unfinished
from jaxcloseup.app.cli.start import in_one_sentence, loading, set_up
from jaxcloseup.app.cli.topics import share


FLAGS = flags.FLAGS
_PLAIN = "images", "photographs", "photos", "pictures"  # names of folders that say nothing
OPERANDS = 1  # what to look at
share(TIME, CHECK, OUTPUT, ["data"])
flags.DEFINE_multi_string(
    "at",
    [],
    "PHOTOGRAPH:x,y, a pixel at the photograph's own size to look at; repeatable; or best: the "
    "three places where photographs show most, which is the default",
)
flags.DEFINE_float(
    "near", 4.0, "how many times nearer than the photograph", lower_bound=1, upper_bound=1000
)
flags.DEFINE_bool("single_file", False, "write the page as one file that holds everything")
flags.DEFINE_bool("mesh", False, "also write the surface as a textured mesh; needs the extra mesh")


def main(arguments: list[str]) -> None:
    """Make the close-ups and the page that the command line asks for."""
    name = program_name("closeup")
    if len(arguments) != 2:
        sys.exit(f"{name}: name photographs, a video, a capture or a run, as in {name} photographs")
    with in_one_sentence("closeup", ValueError, OSError):
        asked = [] if FLAGS.at == ["best"] else [_parse_place(text) for text in FLAGS.at]
        source, kind = arguments[1], _kind(arguments[1])
        if FLAGS.data is not None and kind != "run":
            raise ValueError(f"--data={FLAGS.data} is for a run whose capture was moved")
        folder = _folder(source, kind)
        check_folder(source, kind, folder, mesh=FLAGS.mesh)
    when_stopped(lambda: _say_stopped(folder))
    with in_one_sentence("closeup", OSError):
        lock = lock_output_dir(folder)
    with lock:
        began = time.perf_counter()
        with in_one_sentence("closeup", ValueError, OSError):
            check_source(source, kind, folder)
        run = _trained(source, kind, folder)
        _present(folder, run, asked, _name(source) if kind in ("photographs", "video") else None)
        if FLAGS.mesh:
            _make_mesh(folder, run)
    minutes, seconds = divmod(round(time.perf_counter() - began), 60)
    print(f"took {minutes}:{seconds:02} minutes")
    print(f"open {folder / 'share' / 'index.html'} in a browser, or send the folder it lies in")


def _present(
    folder: pathlib.Path,
    run: pathlib.Path,
    asked: list[tuple[str, tuple[float, float]]],
    title: str | None,
) -> None:
    with loading():
        from jaxcloseup.app import progress
        from jaxcloseup.app.run.loop import TrainingError
        from jaxcloseup.app.share.present import present
        from jaxcloseup.app.store.stored_run import RunError, choose_stage, read_run
        from jaxcloseup.app.view.camera_paths import CameraError
        from jaxcloseup.artifacts.checkpoints import CheckpointError
        from jaxcloseup.photos.scene import SceneError
    set_up()
    expected = (RunError, CameraError, SceneError, CheckpointError, TrainingError)
    with in_one_sentence("closeup", *expected, ValueError, OSError), progress.showing():
        record = read_run(run)
        stage = choose_stage(record, None)
        looks = {"near": FLAGS.near, "single_file": FLAGS.single_file, "title": title}
        paths = present(folder, record, stage, asked, moved_to=FLAGS.data, **looks)
    print("\n".join(f"wrote {path}" for path in paths[:-1]))


def _trained(source: str, kind: str, folder: pathlib.Path) -> pathlib.Path:
    """Return the folder of the run; find poses and train first, as far as that is not done."""
    if kind == "run":
        _say_what_stays(pathlib.Path(source), {}, "name its capture or photographs instead")
        return pathlib.Path(source)
    run, capture = folder / "run", source
    if (run / "results.json").exists():
        # An earlier version wrote none of these flags down.
        _say_what_stays(run, begun(folder), "name another folder with --output_dir")
        return run
    if kind in ("photographs", "video"):
        flag = "images" if kind == "photographs" else "video"
        capture = str(folder / "capture")
        print(f"{source}: {kind} without poses, so these are found first; then {_training()}")
        _start("process", f"--{flag}={source}", f"--output_dir={capture}")
    else:
        print(f"{source}: a {kind}; {_training()}")
    resume, written = ["--resume"] if (run / CHECKPOINTS).is_dir() else [], _written()
    given = [f"--scene={capture}", f"--output_dir={run}", written["minutes"]]
    # A picture is wanted, not a score: all photographs train but those that the capture holds out.
    given += ["--split=listed"] * (kind != "scene")
    checking = [written[name] for name in CHECK if FLAGS[name].value != FLAGS[name].default]
    if not resume:
        with in_one_sentence("closeup", OSError):
            keep(folder, **written)
    _start("run", *given, "--stages=detail", *checking, *resume)
    return run


def _written() -> dict[str, str]:
    """Return the flags of the training by name, as the user writes them."""
    checking = {name: FLAGS[name].serialize() for name in CHECK}
    return {"minutes": f"--minutes={_minutes():g}"} | checking


def _say_what_stays(run: pathlib.Path, before: Mapping[str, str], instead: str) -> None:
    """Print which of the flags that are given come too late for a run that trained with others."""
    late = [
        text
        for name, text in _written().items()
        if not FLAGS[name].using_default_value and text != before.get(name)
    ]
    if late:
        print(f"{run} is trained and stays as it is: to train with {' '.join(late)}, {instead}")


def _make_mesh(folder: pathlib.Path, run: pathlib.Path) -> None:
    """Start the program mesh unless its mesh is there; one that was cut off is made anew."""
    mesh, mark = folder / "mesh", folder / MESH_BEGUN
    if not (mesh / "mesh.json").exists():
        with in_one_sentence("closeup", OSError):
            check_mesh(folder)  # again: training may have taken hours
            if mark.exists() and mesh.exists():
                shutil.rmtree(mesh)
            mark.touch()
        given = [f"--data={FLAGS.data}"] if FLAGS.data is not None else []
        _start("mesh", f"--run={run}", *given, f"--output_dir={mesh}", "--texture=4096")
    mark.unlink(missing_ok=True)


def _minutes() -> float:
    return 10.0 if FLAGS.minutes is None else FLAGS.minutes


def _training() -> str:
    return (
        f"training for about {_minutes():g} minutes, and about 3 for depth, detail, close-ups "
        "and the page"
    )


def _start(program: str, *given: str) -> None:
    """Run another program of this package, and end if it fails: it says why, unless killed."""
    print(shlex.join([*program_command(program), *given]), flush=True)
    done = subprocess.run([sys.executable, "-m", "jaxcloseup", program, *given])
    if done.returncode < 0:
        number = -done.returncode
        reason = f"signal {number} ({signal.strsignal(number)})"
        reason += ", perhaps for lack of memory" * (number == signal.SIGKILL)
        sys.exit(
            f"{program_name('closeup')}: the program {program} was ended by {reason}: go on with "
            "the same command"
        )
    if done.returncode:
        sys.exit(done.returncode)


def _kind(source: str) -> str:
    """Return what a path holds: scene, video, run, capture or photographs."""
    from jaxcloseup.captures.detection import detect
    from jaxcloseup.captures.load import DRAWN_SCENES
    from jaxcloseup.photos.scene import SceneError

    path = pathlib.Path(source)
    if source in DRAWN_SCENES:
        return "scene"
    if not path.exists():
        raise FileNotFoundError(f"{source} does not exist: name a folder or a video")
    if path.is_file():
        return "video"
    if (path / CHECKPOINTS).is_dir():
        return "run"
    try:
        detect(path, None)
    except SceneError:
        return "photographs"
    return "capture"


def _folder(source: str, kind: str) -> pathlib.Path:
    if FLAGS.output_dir is not None:
        return pathlib.Path(FLAGS.output_dir)
    if kind == "run":
        return pathlib.Path(source)
    return pathlib.Path("outputs", _name(source), "closeup")


def _name(source: str) -> str:
    """Return what to call a path of photographs, a video or a capture."""
    path = pathlib.Path(source).resolve()
    if path.name.lower() in _PLAIN:
        return path.parent.name
    return path.name if path.is_dir() else path.stem


def _parse_place(text: str) -> tuple[str, tuple[float, float]]:
    found = re.fullmatch(r"(.+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", text)
    if found is None:
        raise ValueError(
            f"--at={text} must be PHOTOGRAPH:x,y, as in --at=IMG_0003:2000,1300, or best, alone"
        )
    return found[1], (float(found[2]), float(found[3]))


def _say_stopped(folder: pathlib.Path) -> str:
    remove_unfinished(folder)
    command = [*program_command("closeup"), *sys.argv[1:]]
    return f"stopped: go on with {shlex.join(command)}"
