"""Logs of training: `stats/train.jsonl`, and event files for TensorBoard.

Checkpoints decide which steps count. When a stage starts or resumes, both logs are rewritten to
match its history. Steps after the last checkpoint are redone, and so logged only once.
"""

import json
import pathlib
import time
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcloseup.artifacts.images import Image, encode_png
from jaxcloseup.io.files import append_file, read_bytes, strict, write_file


_RATES = ("steps_per_second", "seconds")


def check_tensorboard() -> None:
    """Raise a ValueError if tensorboardX, which writes event files, is not installed."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        raise ValueError(
            '--tensorboard needs tensorboardX: install jaxcloseup with the extra "tensorboard"'
        ) from None


class TrainLog:
    """The log of a run, or of one scene of a sweep.

    `stats/<scene>/train.jsonl` has a line for each chunk of steps: `stage`, `step` within it, the
    chunk's metrics (null if not finite), `steps_per_second` of the chunk, and `seconds` of training
    in the stage so far. The last two are null for a chunk whose line was lost.
    `tb/<scene>/<stage>` has the same values, and evaluations, as event files.

    `scene` names the scene in a sweep, and is empty for a run.
    """

    def __init__(self, folder: pathlib.Path, scene: str = "", *, tensorboard: bool = False) -> None:
        """Set the paths; `begin` writes the first files."""
        self._file = folder / "stats" / scene / "train.jsonl"
        self._folder = folder / "tb" / scene if tensorboard else None
        self._events: _EventFile | None = None
        self._stage: str | None = None
        self._step = 0
        self._seconds = self._start = 0.0

    def begin(self, stage: str, history: Sequence[Mapping[str, Any]]) -> None:
        """Start a stage, or resume it after the chunks of `history`.

        Raises:
          OSError: the log cannot be read or written.
        """
        old = self._read()
        stages: dict[str, list[Mapping[str, Any]]] = {}
        for read in filter(None, map(_parse, old.splitlines())):
            stages.setdefault(read["stage"], []).append(read)
        logged = {line["step"]: line for line in stages.get(stage, ())}
        rates: dict[str, float | None] = dict.fromkeys(_RATES)
        stages[stage] = [
            {"stage": stage, **entry}
            | {key: logged.get(entry["step"], rates)[key] for key in rates}
            for entry in history
        ]
        new = b"".join(_format(line) for lines in stages.values() for line in lines)
        if new != old:  # rewriting an unchanged file would break `tail -f`
            write_file(self._file, new)
        last: Mapping[str, Any] = stages[stage][-1] if history else {"step": 0, "seconds": 0.0}
        self._step, self._seconds = last["step"], last["seconds"] or 0.0
        self._start = time.perf_counter() - self._seconds
        self._open(stage)
        for sent in stages[stage]:
            self._send(sent)

    def write(self, entry: Mapping[str, Any]) -> None:
        """Log the newest chunk of the stage's history."""
        seconds = time.perf_counter() - self._start
        rate = (entry["step"] - self._step) / (seconds - self._seconds)
        self._step, self._seconds = entry["step"], seconds
        line = {"stage": self._stage, **entry, "steps_per_second": rate, "seconds": seconds}
        append_file(self._file, _format(line))
        self._send(line)

    def evaluated(
        self, stage: str, splits: Mapping[str, Mapping[str, Any]], images: Mapping[str, Image]
    ) -> None:
        """Write a stage's evaluation to its event file.

        A stage that took no steps uses the step of the stage before it.

        `splits` has metrics by split, and `images` has images by tag.
        """
        if stage != self._stage:
            self._open(stage)
        if self._events is not None:
            numbers = {
                f"{s}/{key}": value
                for s, metrics in splits.items()
                for key, value in metrics.items()
            }
            self._events.write(self._step, numbers, images)

    def _read(self) -> bytes:
        try:
            return read_bytes(self._file) if self._file.exists() else b""
        except OSError as error:
            raise OSError(
                f"{self._file} cannot be read ({error.strerror}): remove it to log anew"
            ) from error

    def _open(self, stage: str) -> None:
        self._stage = stage
        if self._folder is not None:
            self._events = _EventFile(self._folder / stage)

    def _send(self, line: Mapping[str, Any]) -> None:
        if self._events is not None:
            numbers = {f"train/{key}": value for key, value in line.items() if key != "step"}
            ago = self._seconds - (line["seconds"] or 0.0)
            self._events.write(line["step"], numbers, ago=ago)


class _EventFile:
    """A new event file in a folder, which replaces older ones without deleting them.

    A TensorBoard that reads an old file would stop if the file disappeared. The second event of the
    new file tells TensorBoard to forget all steps from 0 on. The class uses tensorboardX's
    `EventsWriter`, because `SummaryWriter` queues events and a killed run loses the queue.
    """

    def __init__(self, folder: pathlib.Path) -> None:
        from tensorboardX.event_file_writer import EventsWriter

        folder.mkdir(parents=True, exist_ok=True)
        # TensorBoard reads files in the order of their names, which hold only seconds.
        self._writer = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
        weakref.finalize(self, self._writer.close)
        self._add(step=0, session_log={"status": "START"})

    def write(
        self,
        step: int,
        numbers: Mapping[str, Any],
        images: Mapping[str, Image] | None = None,
        *,
        ago: float = 0.0,
    ) -> None:
        """Write the numbers and images of a step that ended `ago` seconds ago; skip the rest."""
        values: list[dict[str, Any]] = [
            {"tag": tag, "simple_value": number}
            for tag, number in numbers.items()
            if isinstance(number, int | float)
        ]
        for tag, image in (images or {}).items():
            size = {"height": image.shape[0], "width": image.shape[1], "colorspace": 3}
            png = encode_png(image)
            values.append({"tag": tag, "image": {**size, "encoded_image_string": png}})
        self._add(ago, step=step, summary={"value": values})

    def _add(self, ago: float = 0.0, **fields: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self._writer.write_event(Event(wall_time=time.time() - ago, **fields))
        self._writer.flush()


def _parse(text: bytes) -> dict[str, Any] | None:
    """Parse a line of the log; None for a truncated or damaged one."""
    try:
        line = json.loads(text)
        kinds: dict[str, Any] = {"stage": str, "step": int}
        kinds |= dict.fromkeys(_RATES, float | int | None)
        whole = all(isinstance(line[name], kind) for name, kind in kinds.items())
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return line if whole else None


def _format(line: Mapping[str, Any]) -> bytes:
    return json.dumps(strict(line), allow_nan=False).encode() + b"\n"
