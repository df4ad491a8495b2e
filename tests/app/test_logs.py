"""Logs of training: each step once, also after interruptions; event files read byte by byte."""

import json
import math
import struct
import sys
import time
import types

import cv2
import numpy as np
import pytest
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import run, sweep
from jaxcloseup.app.run import logs
from jaxcloseup.app.run.logs import TrainLog


HISTORY = [{"step": 10 * i, "loss": 1 / i, "skipped": 0} for i in range(1, 5)]


def read_lines(folder):
    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    text = (folder / "stats" / "train.jsonl").read_text()
    assert text.endswith("\n")
    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


@pytest.fixture
def clock(monkeypatch):
    """Replace the clock by one that the test moves; `perf_counter` starts at 0."""
    clock = types.SimpleNamespace(now=1000.0, time_ns=time.time_ns)
    clock.perf_counter = lambda: clock.now - 1000
    clock.time = lambda: clock.now
    monkeypatch.setattr(logs, "time", clock)
    return clock


def train(clock, folder, stage, *, history, resumed=0, **options):
    """Log chunks of 5 seconds each, after a pause of 100 seconds."""
    clock.now += 100
    log = TrainLog(folder, **options)
    log.begin(stage, history[:resumed])
    for entry in history[resumed:]:
        clock.now += 5
        log.write(entry)
    return log


def test_lines_follow_the_training_in_one_file(tmp_path, clock):
    log = TrainLog(tmp_path)
    log.begin("baseline", [])
    clock.now += 1
    log.write(HISTORY[0])
    with (tmp_path / "stats" / "train.jsonl").open() as follower:
        assert len(follower.readlines()) == 1
        for entry in HISTORY[1:]:
            clock.now += 4
            log.write(entry)
            assert json.loads(follower.readline())["step"] == entry["step"]
        log.begin("closeup", [])
        clock.now += 2
        log.write({"step": 3, "loss": 0.5})
        last = json.loads(follower.readline())
    expected = {"stage": "closeup", "step": 3, "loss": 0.5, "steps_per_second": 1.5, "seconds": 2.0}
    assert list(last.items()) == list(expected.items())
    lines = read_lines(tmp_path)
    assert [line["stage"] for line in lines] == ["baseline"] * 4 + ["closeup"]
    assert [{key: line[key] for key in HISTORY[0]} for line in lines[:4]] == HISTORY
    assert [line["seconds"] for line in lines[:4]] == [1, 5, 9, 13]
    assert [line["steps_per_second"] for line in lines[:4]] == [10, 2.5, 2.5, 2.5]


@pytest.mark.parametrize("torn", [b"", b'{"stage": "closeup", "st', b"\xff\x00", b"{}\n7\n"])
def test_steps_after_the_checkpoint_are_logged_once(tmp_path, clock, torn):
    train(clock, tmp_path, "baseline", history=HISTORY[:2])
    train(clock, tmp_path, "closeup", history=HISTORY[:3])
    first = read_lines(tmp_path)
    with (tmp_path / "stats" / "train.jsonl").open("ab") as file:
        file.write(torn)
    train(clock, tmp_path, "baseline", history=HISTORY[:2], resumed=2)
    train(clock, tmp_path, "closeup", history=HISTORY, resumed=1)
    lines = read_lines(tmp_path)
    assert lines[:3] == first[:3]
    logged = [(line["stage"], line["step"]) for line in lines[3:]]
    assert logged == [("closeup", 20), ("closeup", 30), ("closeup", 40)]
    assert [line["seconds"] for line in lines] == [5, 10, 5, 10, 15, 20]
    assert {line["steps_per_second"] for line in lines} == {2.0}


def test_a_lost_line_is_restored_from_the_checkpoint(tmp_path, clock):
    train(clock, tmp_path, "baseline", history=HISTORY, resumed=3)
    lines = read_lines(tmp_path)
    assert [line["loss"] for line in lines] == [entry["loss"] for entry in HISTORY]
    assert [line["seconds"] for line in lines] == [None] * 3 + [5]


@pytest.mark.skipif("not os.path.exists('/dev/full')", reason="needs /dev/full, which Linux has")
def test_a_full_disk_raises_one_sentence(tmp_path, clock):
    log = TrainLog(tmp_path)
    log.begin("baseline", [])
    (tmp_path / "stats").mkdir()
    (tmp_path / "stats/train.jsonl").symlink_to("/dev/full")
    clock.now += 1
    with pytest.raises(OSError, match=r"train\.jsonl cannot be written \(No space left .* make"):
        log.write(HISTORY[0])


def test_lines_are_strict_json(tmp_path, clock):
    train(clock, tmp_path, "baseline", history=[{"step": 1, "loss": math.nan, "psnr": math.inf}])
    (line,) = read_lines(tmp_path)
    assert line["loss"] is None and line["psnr"] is None


def crc32c(data):
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF  # masked, as in TFRecord


def read_events(folder):
    """Read a folder's events; a start event voids earlier events from its step on."""
    from tensorboardX.proto.event_pb2 import Event

    events = []
    for file in sorted(folder.glob("*tfevents*")):
        for event in read_records(file.read_bytes(), Event.FromString):
            if event.session_log.status == event.session_log.START:
                events = [old for old in events if old.step < event.step]
            elif event.file_version:
                assert event.file_version == "brain.Event:2"
            else:
                events.append(event)
    return events


def read_records(data, parse):
    while data:
        (size, check), body = struct.unpack("<QI", data[:12]), data[12:]
        assert check == crc32c(data[:8])
        assert struct.unpack("<I", body[size : size + 4]) == (crc32c(body[:size]),)
        yield parse(body[:size])
        data = body[size + 4 :]


def test_event_files_match_the_history_and_never_go_backwards(tmp_path, clock):
    pytest.importorskip("tensorboardX", reason='needs tensorboardX (the extra "tensorboard")')
    log = train(clock, tmp_path, "closeup", history=HISTORY[:3], tensorboard=True)
    train(
        clock, tmp_path, "closeup", history=HISTORY, resumed=1, tensorboard=True
    )  # the first log was killed
    del log
    log = TrainLog(tmp_path, tensorboard=True)
    log.begin("closeup", HISTORY)
    image = np.random.default_rng(0).uniform(size=(6, 8, 3))
    summary = {"psnr": 21.5, "lpips_vgg": None, "lpips_vgg_reason": "no weights", "views": {}}
    log.evaluated("closeup", {"test": summary}, {"test/0": image})
    events = read_events(tmp_path / "tb" / "closeup")
    found = [{v.tag: v.simple_value for v in event.summary.value} for event in events]
    assert [event.step for event in events] == [10, 20, 30, 40, 40]
    for values, entry in zip(found, HISTORY, strict=False):
        assert values["train/loss"] == pytest.approx(entry["loss"])
        assert "train/seconds" in values
    assert set(found[-1]) == {"test/psnr", "test/0"} and found[-1]["test/psnr"] == 21.5
    png = events[-1].summary.value[-1].image
    assert (png.height, png.width) == (6, 8)
    pixels = cv2.imdecode(np.frombuffer(png.encoded_image_string, np.uint8), 1)[..., ::-1]
    np.testing.assert_array_equal(pixels, np.rint(image * 255))
    assert [event.wall_time - clock.now for event in events] == [-15, -10, -5, 0, 0]
    # A stage without steps has the step of the stage before it.
    log.evaluated("test_time", {"test": summary}, {})
    assert [event.step for event in read_events(tmp_path / "tb" / "test_time")] == [40]
    assert len(read_events(tmp_path / "tb" / "closeup")) == 5


@pytest.mark.parametrize("program", [run, sweep])
def test_missing_tensorboard_exits_with_one_sentence(program, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    flags.FLAGS(["run"])
    out = str(tmp_path / "out")
    with (
        flagsaver.flagsaver(compilation_cache="", tensorboard=True, output_dir=out),
        pytest.raises(SystemExit, match=r'--tensorboard needs .* the extra "tensorboard"'),
    ):
        program.main(["run"])
    assert not (tmp_path / "out").exists()
