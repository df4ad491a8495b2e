"""What a run says while it trains: `stats/train.jsonl`, and event files of TensorBoard.

Checkpoints decide what has happened. When a stage is begun or gone on with, both are brought to its
history: what was said after its last checkpoint is said again when it is done again.
"""

import json
import pathlib
import time
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcloseup.artifacts.images import Image, encode_png
from jaxcloseup.files import append_file, strict, write_file


def check_tensorboard() -> None:
    """Raise a ValueError where event files cannot be written."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        raise ValueError(
            '--tensorboard needs tensorboardX: install jaxcloseup with the extra "tensorboard"'
        ) from None


class TrainLog:
    """The log of a run, or of one scene of a sweep.

    `stats/<scene>/train.jsonl` has a line for each chunk of steps: `stage`, `step` within it, the
    chunk's metrics (one that is not finite is left out, as in results.json), `steps_per_second` of
    the chunk and `seconds` of the stage so far, without those between a cut and its resumption;
    null where nobody knows. `tb/<scene>/<stage>` has the same, and evaluations, as event files.

    Args:
      folder: of the run or the sweep.
      scene: of a sweep.
      tensorboard: whether to write event files.
    """

    def __init__(self, folder: pathlib.Path, scene: str = "", *, tensorboard: bool = False) -> None:
        """Write nothing yet."""
        self._file = folder / "stats" / scene / "train.jsonl"
        self._folder = folder / "tb" / scene if tensorboard else None
        self._events: _EventFile | None = None
        self._stage: str | None = None
        self._step, self._seconds, self._start = 0, 0.0, 0.0

    def begin(self, stage: str, history: Sequence[Mapping[str, Any]]) -> None:
        """Begin a stage, or go on with it after the chunks of `history`."""
        old = self._file.read_bytes() if self._file.exists() else b""
        stages: dict[str, list[Mapping[str, Any]]] = {}
        for line in filter(None, map(_parse, old.splitlines())):
            stages.setdefault(line["stage"], []).append(line)
        said = {line["step"]: line for line in stages.get(stage, ())}
        rates = {"steps_per_second": None, "seconds": None}
        stages[stage] = [
            {"stage": stage, **entry} | {key: said.get(entry["step"], rates)[key] for key in rates}
            for entry in history
        ]
        new = b"".join(_format(line) for lines in stages.values() for line in lines)
        if new != old:  # else whoever follows the file would lose it
            write_file(self._file, new)
        last = stages[stage][-1] if history else {"step": 0, "seconds": 0.0}
        self._step, self._seconds = last["step"], last["seconds"] or 0.0
        self._start = time.perf_counter() - self._seconds
        self._open(stage)
        for line in stages[stage]:
            self._send(line)

    def write(self, entry: Mapping[str, Any]) -> None:
        """Say what the newest chunk of the stage's history is."""
        seconds = time.perf_counter() - self._start
        rate = (entry["step"] - self._step) / (seconds - self._seconds)
        self._step, self._seconds = entry["step"], seconds
        line = {"stage": self._stage, **entry, "steps_per_second": rate, "seconds": seconds}
        append_file(self._file, _format(line))
        self._send(line)

    def evaluated(
        self, stage: str, splits: Mapping[str, Mapping[str, Any]], images: Mapping[str, Image]
    ) -> None:
        """Send a stage's metrics by split, and images by their tags, to its event file.

        A stage that took no steps has those of the stage before it.
        """
        if stage != self._stage:
            self._open(stage)
        if self._events is not None:
            numbers = {f"{s}/{key}": value for s, of in splits.items() for key, value in of.items()}
            self._events.write(self._step, numbers, images)

    def _open(self, stage):
        self._stage = stage
        if self._folder is not None:
            self._events = _EventFile(self._folder / stage)

    def _send(self, line):
        if self._events is not None:
            numbers = {f"train/{key}": value for key, value in line.items() if key != "step"}
            ago = self._seconds - (line["seconds"] or 0.0)
            self._events.write(line["step"], numbers, ago=ago)


class _EventFile:
    """A new event file of a folder, which takes the place of older ones.

    These stay, for a TensorBoard that is reading them would stop; the new one's second event tells
    it to forget all steps from 0 on. tensorboardX's `SummaryWriter` keeps events in a queue, which
    a run that is killed loses; what it writes with does not.
    """

    def __init__(self, folder):
        from tensorboardX.event_file_writer import EventsWriter

        folder.mkdir(parents=True, exist_ok=True)
        # The files of a folder are read in the order of their names, which tell seconds.
        self._writer = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
        weakref.finalize(self, self._writer.close)
        self._add(step=0, session_log={"status": "START"})

    def write(self, step, numbers, images=None, *, ago=0.0):
        """What is no number is left out; `ago` is in seconds."""
        values = [
            {"tag": tag, "simple_value": number}
            for tag, number in numbers.items()
            if isinstance(number, int | float)
        ]
        for tag, image in (images or {}).items():
            size = {"height": image.shape[0], "width": image.shape[1], "colorspace": 3}
            png = encode_png(image)
            values.append({"tag": tag, "image": {**size, "encoded_image_string": png}})
        self._add(ago, step=step, summary={"value": values})

    def _add(self, ago=0.0, **fields):
        from tensorboardX.proto.event_pb2 import Event

        self._writer.write_event(Event(wall_time=time.time() - ago, **fields))
        self._writer.flush()


def _parse(text):
    """A line, or None for half of one."""
    try:
        line = json.loads(text)
        return line if {"stage", "step", "steps_per_second", "seconds"} <= line.keys() else None
    except (ValueError, AttributeError):
        return None


def _format(line):
    return json.dumps(strict(line), allow_nan=False).encode() + b"\n"
