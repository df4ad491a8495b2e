"""What a run shows while it computes: by a clock that the test moves, and line by line."""

import io
import os
import pathlib
import re
import select
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from jaxcloseup.app import progress
from jaxcloseup.app.cli.interrupt import STOPPED
from jaxcloseup.app.methods.surfels import PAPER, QUICK
from jaxcloseup.app.process.counting import progress as stage_progress
from jaxcloseup.app.progress import display, threads
from jaxcloseup.app.progress.estimate import Estimate
from jaxcloseup.app.run import plan


PLAN = {"a": 10.0, "b": 20.0, "c": 30.0, "d": 40.0}


class Clock:
    """Seconds of work, which the test moves; compiling takes none of them."""

    now = 0.0

    def wait(self, seconds):
        self.now += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def estimate(clock):
    return Estimate(PLAN, lambda: clock.now)


def test_a_run_that_takes_three_times_as_long_as_planned(estimate, clock):
    assert estimate.left() is None
    estimate.begin("a")
    assert estimate.left() is None and estimate.place == (1, 4)
    clock.wait(30)
    estimate.end()
    assert estimate.left() == pytest.approx(3 * (20 + 30 + 40))
    estimate.begin("b")
    clock.wait(10)
    assert estimate.left() == pytest.approx(50 + 3 * (30 + 40)) and estimate.place == (2, 4)
    clock.wait(500)  # longer than planned: its end is near
    assert estimate.left() == pytest.approx(3 * (30 + 40))


def test_steps_tell_the_time_left(estimate, clock):
    estimate.begin("a")
    estimate.count(0, 100)
    clock.wait(2)
    estimate.count(20, 100)
    assert estimate.rate == pytest.approx(10)
    clock.wait(4)
    estimate.count(40, 100)
    assert estimate.rate == pytest.approx(5)
    # 12 s are left of this part, whose 100 steps take 20 s instead of 10.
    assert estimate.left() == pytest.approx(12 + 2 * (20 + 30 + 40))
    clock.wait(1)
    assert estimate.left() == pytest.approx(11 + 2 * (20 + 30 + 40))
    clock.wait(100)
    estimate.end()
    estimate.begin("b")
    assert estimate.left() == pytest.approx(2 * (20 + 30 + 40))


def test_a_resumed_part_is_measured_by_the_steps_that_it_takes(estimate, clock):
    estimate.begin("a")
    estimate.count(90, 100)
    clock.wait(2)
    estimate.count(100, 100)
    assert estimate.rate == pytest.approx(5)
    estimate.end()
    # A tenth of what was planned to take 10 s took 2.
    assert estimate.left() == pytest.approx(2 * (20 + 30 + 40))


def test_parts_that_are_left_out_are_not_waited_for(estimate, clock):
    estimate.begin("a")
    clock.wait(10)
    estimate.end()
    estimate.begin("unplanned")
    clock.wait(5)
    assert estimate.place is None
    estimate.end()
    estimate.begin("d")
    assert estimate.place == (4, 4) and estimate.left() == pytest.approx(1.5 * 40)


def test_without_a_plan_the_time_of_the_part_is_left(clock):
    estimate = Estimate({}, lambda: clock.now)
    estimate.begin("a")
    estimate.count(0, 100)
    clock.wait(10)
    estimate.count(50, 100)
    assert estimate.left() == pytest.approx(10) and estimate.place is None


def test_silence_is_broken(monkeypatch, capsys):
    monkeypatch.setattr(display, "QUIET", 0.3)
    with progress.showing(PLAN, words=lambda name: f"part {name}"):
        with progress.part("b"), progress.saying("compiling the steps"):
            assert capsys.readouterr().out.splitlines()[-1] == "[2/4] part b, compiling the steps"
            time.sleep(1.4)
            said = capsys.readouterr().out
            assert said.count("\n") >= 2
            assert "[2/4] part b, compiling the steps, 1 s" in said
        with progress.part("c"):
            for i in progress.track(range(3), "views"):
                said = capsys.readouterr().out
                time.sleep(0.6 * (i == 1))
            assert "[3/4] part c, views: 1 of 3" in capsys.readouterr().out + said
            counted = progress.count("c", 0, 20)
            assert re.fullmatch(r"\[3/4\] c  0/20  \d+:\d\d left", counted)
    assert progress.count("c", 5, 10) == "c  5/10"


def test_a_stage_that_counts_breaks_the_silence_too(monkeypatch, capsys):
    monkeypatch.setattr(display, "QUIET", 0.3)
    with progress.showing(), stage_progress("matching", "pairs") as report:
        assert capsys.readouterr().out == "matching\n"
        report(10, 1000)
        time.sleep(0.5)
        report(30, 1000)
        time.sleep(0.7)
    first, *_, shown, last = capsys.readouterr().out.splitlines()
    assert first.startswith("matching: 10 of 1000, 0.0 pairs/s")
    # 20 pairs, because 10 were there before.
    assert re.fullmatch(r"matching: 30 of 1000, [234]\d\.\d pairs/s, 0:[234]\d left(, 1 s)?", shown)
    assert re.fullmatch(r"matching: 30 of 1000, [234]\d\.\d pairs/s", last)


def test_a_terminal_shows_one_line_below_what_is_printed(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    inner = progress.showing(PLAN), progress.part("a"), progress.saying("compiling")
    with pytest.raises(KeyboardInterrupt), progress.showing(), inner[0], inner[1], inner[2]:
        print("a sentence")
        time.sleep(0.8)
        raise KeyboardInterrupt
    said = terminal.getvalue()
    assert "a sentence\n" in said and re.search(r"\[1/4\] a .*compiling", said)
    assert said.count("\x1b[1A") == 1  # one line is removed at the end
    assert said.rindex("\x1b[?25h") > said.rindex("[1/4] a")  # the cursor is back
    assert progress.count("a", 1, 2) == "a 1/2"


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_ctrl_c_leaves_a_terminal_with_a_cursor():
    program = (
        "import time\n"
        "from jaxcloseup.app import progress\n"
        "from jaxcloseup.app.cli.interrupt import end_at_ctrl_c\n"
        "end_at_ctrl_c('program')\n"
        "with progress.showing(), progress.saying('waiting'):\n"
        "    time.sleep(60)\n"
    )
    terminal, inner = os.openpty()

    def read_until(end):
        said = b""
        while end not in said:
            assert select.select([terminal], [], [], 60)[0], said
            said += os.read(terminal, 4096)
        return said

    # A test session that a shell started in the background ignores Ctrl-C.
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=inner,
        stdout=inner,
        stderr=inner,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "80"},
        cwd=pathlib.Path(__file__).parents[2],
    )
    signal.signal(signal.SIGINT, ours)
    with process:
        said = read_until(b"waiting")
        process.send_signal(signal.SIGINT)
        said += read_until(b"program: stopped")
    # Held open until here: where nobody holds it, what was not read yet may be lost.
    os.close(inner)
    os.close(terminal)
    assert process.returncode == STOPPED
    assert said.rindex(b"\x1b[?25h") > said.rindex(b"\x1b[?25l")


def test_steps_on_whole_photographs_take_most_of_a_run():
    """Scoring takes as long as after a short training, so the estimate must not scale it up."""
    cameras = SimpleNamespace(height=540, width=960)
    scene = SimpleNamespace(train=SimpleNamespace(cameras=cameras), test=None, surface=None)
    quick, paper = (plan.plan_run(preset, scene, ["control"]) for preset in (QUICK, PAPER))
    assert paper["baseline_evaluation"] == quick["baseline_evaluation"]
    assert "poses" in quick and "poses" not in paper
    assert paper["baseline"] > 0.95 * sum(paper.values())
    assert quick["baseline"] == pytest.approx(0.03 * 6500)


def test_parts_have_words():
    assert plan.in_words("control_evaluation") == "scoring control"
    assert plan.in_words("refine_baseline").startswith("adding surfels")
    assert plan.in_words("coarse_baseline") == "coarse_baseline"


@pytest.mark.parametrize(
    ("cores", "pixels", "workers"),
    [(1, 1, 1), (2, 1, 2), (64, 1, 4), (64, 2**21, 2), (64, 2**23, 1)],
)
def test_each_keeps_the_order(monkeypatch, cores, pixels, workers):
    """Later values may be done first; the first is done before another one begins."""
    monkeypatch.setattr(threads.os, "cpu_count", lambda: cores)
    begun, ended, before_second = [], [], []

    def give(value):
        begun.append(value)
        if value == 1:
            before_second.extend(ended)
        time.sleep(0.02 if value % 2 else 0)
        ended.append(value)
        return -value

    found = progress.each(give, range(9), "values", pixels=pixels)
    assert next(found) == 0
    assert len(begun) <= 1 + workers + 1  # no more is held than threads work on
    assert list(found) == [-value for value in range(1, 9)]
    assert before_second == [0]
    assert sorted(ended) == list(range(9))
    assert list(progress.each(give, [], "values")) == []


@pytest.mark.parametrize("cores", [1, 2])
@pytest.mark.parametrize("bad", [0, 3])
def test_each_passes_an_error_on(monkeypatch, cores, bad):
    monkeypatch.setattr(threads.os, "cpu_count", lambda: cores)
    begun = []

    def give(value):
        begun.append(value)
        if value == bad:
            raise ValueError("no such value")
        return value

    found = []
    with pytest.raises(ValueError, match="no such value"):
        for value in progress.each(give, range(100), "values"):
            found.append(value)
    assert found == list(range(bad))
    assert len(begun) < 20
