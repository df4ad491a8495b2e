"""Damaged files of all kinds: a reader says one sentence, or returns what can be used.

`JAXCLOSEUP_FUZZ=5000` reads so many instead of the usual number, and `JAXCLOSEUP_FUZZ=17:18` the
seventeenth again.
"""

import collections
import json
import os
import pathlib
import selectors
import subprocess
import sys

import pytest


MUTATIONS = 300
HANG = 10  # seconds of a computer that does nothing else
PATIENCE = 3  # times as long on a busy one


class Worker:
    """A process that reads damaged files, started again after each hang or crash."""

    def __init__(self, folder, run):
        self.refused, self.read_well = collections.Counter(), collections.Counter()
        self._command = [sys.executable, str(pathlib.Path(__file__).parents[1] / "fuzzing.py")]
        self._command += [str(folder), str(run)]
        self._process = None

    def read(self, number):
        """What came of a mutation; a fault is a text."""
        if self._process is None:
            self._start()
        self._process.stdin.write(f"{number}\n")
        self._process.stdin.flush()
        answer = self._answer(PATIENCE * HANG)
        if answer is None:
            fault = f"no answer for {PATIENCE * HANG} s"
        elif answer == "":
            fault = f"the process ended with {self._process.wait()}"
        else:
            answer = json.loads(answer)
            fault = answer["fault"]
            (self.refused if answer["refused"] else self.read_well)[answer["case"]] += 1
            if answer["seconds"] > HANG:
                fault = f"took {answer['seconds']:.0f} s"
            return fault and f"{number}, {answer['case']}, {answer['what']}: {fault}"
        self.close()
        return f"{number}: {fault}"

    def _start(self):
        root = pathlib.Path(__file__).parents[2]
        path = os.pathsep.join([str(root), str(root / "tests")])
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path, "XLA_FLAGS": ""},
            text=True,
            bufsize=1,
        )
        assert self._answer(120) == "ready\n", "the process does not start"

    def _answer(self, seconds):
        """A line; empty where the process ended, and None where it says nothing so long."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            return self._process.stdout.readline() if selector.select(seconds) else None

    def close(self):
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@pytest.fixture
def worker(tmp_path, kept):
    pytest.importorskip("pycolmap")
    worker = Worker(tmp_path, kept)
    yield worker
    worker.close()


def test_damaged_files_are_refused_in_a_sentence_or_read_sanely(worker):
    first, colon, last = os.environ.get("JAXCLOSEUP_FUZZ", str(MUTATIONS)).partition(":")
    numbers = range(int(first), int(last)) if colon else range(int(first))
    faults = [fault for number in numbers if (fault := worker.read(number))]
    print(f"refused: {dict(worker.refused)}; read: {dict(worker.read_well)}")
    assert not faults, f"{len(faults)} of {len(numbers)}:\n" + "\n".join(faults)
    if len(numbers) >= MUTATIONS:  # most damage is seen, and some does no harm
        for outcomes in (worker.refused, worker.read_well):
            assert len(outcomes) > 10 and sum(outcomes.values()) > len(numbers) / 10
