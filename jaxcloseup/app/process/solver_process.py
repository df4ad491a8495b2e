"""Start the solver's process, show its progress, and explain its failure in one sentence."""

import contextlib
import importlib.util
import json
import os
import pathlib
import signal
import subprocess
import sys
from typing import Any

import jaxcloseup
from jaxcloseup.app.process.counting import progress


class ProcessingError(RuntimeError):
    """No capture can be made. The message is one sentence that says why, and what to do."""


def check_pycolmap() -> None:
    """Raise a ProcessingError if pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise ProcessingError(
            "finding poses needs pycolmap: install it with pip install 'jaxcloseup[colmap]'"
        )


def run_job(job: str, what: str, unit: str, log: pathlib.Path, **arguments: Any) -> Any:
    """Run a job of `jaxcloseup.app.process.solver` in a separate process.

    Args:
      job: name of the job.
      what: description for the line of progress.
      unit: unit of its progress, in the plural.
      log: file that COLMAP's messages are appended to.
      **arguments: arguments of the job, as JSON holds them.

    Returns:
      The result of the job.

    Raises:
      ProcessingError: the process failed or was killed.
      OSError: the log cannot be written.
    """
    root = str(pathlib.Path(jaxcloseup.__file__).parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    with (
        log.open("ab") as messages,
        subprocess.Popen(
            [sys.executable, "-m", "jaxcloseup.app.process.solver"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=messages,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            encoding="utf-8",
            start_new_session=True,  # Ctrl-C is for this process, whose end ends the other
        ) as process,
        progress(what, unit) as report,
    ):
        assert process.stdin is not None and process.stdout is not None  # both are pipes
        answer: dict[str, Any] = {}
        try:
            process.stdin.write(json.dumps({"job": job, **arguments}) + "\n")
            process.stdin.flush()
            for line in process.stdout:
                answer = json.loads(line) if line.endswith("\n") else {}
                if "done" in answer:
                    report(answer["done"], answer["of"])
        except BrokenPipeError:
            pass
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        code = process.wait()
    if "result" not in answer:
        reason = f"ended with code {code}" if code >= 0 else f"was ended by {_signal(-code)}"
        if code == -signal.SIGKILL:
            reason += ", perhaps for lack of memory"
        raise ProcessingError(f"pycolmap {reason} in {what}: {log} ends with what it said")
    return answer["result"]


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
