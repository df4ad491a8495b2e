"""A sweep of methods: one process for each method and scene, what is finished stays, one table."""

import json
import sys

import pytest
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import sweep
from jaxcloseup.io.files import write_json


# PSNR of control by method and scene; the other arm has 1 dB more.
PSNR = {("ngp", "table"): 20.0, ("ngp", "room"): 22.0, ("surfels", "table"): 25.0}
PSNR["surfels", "room"] = 26.0


def leave_results(folder, method, scene):
    """What a finished sweep of one seed leaves."""

    def splits(psnr):
        return {
            "test": {"psnr": psnr, "depth_error_median": 0.25},
            "test_far": {"psnr": psnr + 5, "point_depth_error_median": 0.5},
            "zoom_0.5": {"psnr": psnr + 0.5},
            "zoom_2": {"psnr": psnr - 2},
        }

    psnr = PSNR[method, scene]
    arms = {"control": {"0": {"skipped": 0, "splits": splits(psnr)}}}
    arms["diverse"] = {"0": {"skipped": 0, "splits": splits(psnr + 1)}}
    write_json(folder / "sweep.json", {"scenes": {scene: arms}})
    used = {"core_seconds": 600.0, "peak_bytes": 2**31}
    write_json(folder / "manifest.json", {"finished": True, **used})


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Sweep methods with processes that only leave results; returns the commands of these."""
    monkeypatch.setattr(sys, "argv", [sweep.__file__])
    flags.FLAGS(["sweep", "--seeds=1"])

    def call(methods, scenes, *, broken=(), **given):
        commands = []

        def start(command):
            commands.append(command)
            words = dict(word[2:].partition("=")[::2] for word in command[4:])
            done = (words["method"], words["scenes"]) not in broken
            if done:
                leave_results(
                    tmp_path / "out" / words["method"] / words["scenes"],
                    *(words[name] for name in ("method", "scenes")),
                )
            return 0 if done else 1

        monkeypatch.setattr("jaxcloseup.app.sweep.method_sweeps.call", start)
        names = {"methods": methods, "scenes": scenes, "output_dir": str(tmp_path / "out")}
        with flagsaver.flagsaver(compilation_cache="", **(names | given)):
            sweep.main(["sweep"])
        return commands

    return call


def rows_of(text, title):
    """The cells of the tables below a title, by the first of each line."""
    (part,) = [part for part in text.split("## ") if part.startswith(title)]
    lines = [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("|")]
    found = {}
    for first, *others in lines:
        found.setdefault(first, []).extend(others)
    return found


def test_one_table_has_all_methods(run, tmp_path):
    commands = run(["ngp"], ["table", "room"])
    assert [command[1:3] for command in commands] == [["-m", "jaxcloseup"]] * 2
    assert all("--seeds=1" in command for command in commands)
    assert f"--output_dir={tmp_path / 'out' / 'ngp' / 'room'}" in commands[1]
    # Another method later; what is finished is not made again.
    (command,) = run(["ngp", "surfels"], ["table"], resume=True)
    assert {"--method=surfels", "--scenes=table"} <= set(command)
    commands = run(["ngp", "surfels"], ["table", "room"], resume=True)
    text = (tmp_path / "out" / "methods.md").read_text()
    table = rows_of(text, "table")
    costs = ["10.0", "2.00"]
    ngp = ["20.00", "21.00", "25.00", "26.00", "25.00%", "50.00%", *costs, "20.50", "18.00"]
    assert table["ngp"] == ngp
    assert table["surfels"][:2] == ["25.00", "26.00"]
    assert rows_of(text, "mean of table, room")["ngp"][:2] == ["21.00", "22.00"]
    assert json.loads((tmp_path / "out" / "methods.json").read_text())["ngp"]["room"]["arms"]


def test_one_that_fails_costs_no_other(run, tmp_path, capsys):
    with pytest.raises(SystemExit, match="left out, for the reasons above: ngp on table"):
        run(["ngp", "surfels"], ["table"], broken=[("ngp", "table")])
    assert "ngp" not in rows_of((tmp_path / "out" / "methods.md").read_text(), "table")
    (command,) = run(["ngp", "surfels"], ["table"], resume=True)
    assert "--method=ngp" in command


def test_a_sweep_with_other_flags_is_not_mixed_in(run, tmp_path):
    run(["ngp"], ["table"])
    before = (tmp_path / "out" / "methods.md").read_text()
    with pytest.raises(SystemExit, match=r"out was begun with --seeds=1: resume it as it was"):
        run(["ngp", "surfels"], ["table"], resume=True, seeds=3)
    assert (tmp_path / "out" / "methods.md").read_text() == before
    with pytest.raises(SystemExit, match="--scenes=a/table,table has two of one name"):
        run(["ngp"], ["a/table", "table"], resume=True)


@pytest.mark.parametrize(
    ("methods", "given", "message"),
    [
        (["ngp", "ngp"], {}, "--methods=ngp,ngp must name some of surfels, .*, each once"),
        (["sharp"], {}, "--methods=sharp must name some of"),
        (["ngp", "surfels"], {"preset": "reduced"}, "--preset=reduced is not for --method=ngp"),
        (["surfels", "ngp"], {"arms": ["depth=1"]}, "--arms=depth=1"),
        (["ngp"], {"resume": True}, "--resume finds nothing to resume in --output_dir=.*out"),
    ],
)
def test_a_mistake_is_one_sentence_before_anything_begins(run, tmp_path, methods, given, message):
    with pytest.raises(SystemExit, match=message):
        run(methods, ["table"], **given)
    assert not (tmp_path / "out").exists()
