"""The manifest of a run: hashes of the data, the commit, and how to load the scene again."""

import dataclasses
import json
import shutil
import subprocess

import pytest
from absl import flags
from absl.testing import flagsaver

from jaxcloseup.app.cli import sweep as program
from jaxcloseup.app.run import manifest
from jaxcloseup.app.run.manifest import about_scene, git_commit, hash_data
from jaxcloseup.app.sweep import scene_sweeps
from jaxcloseup.app.sweep.arm_scoring import SweepOutcome
from jaxcloseup.captures.load import load_scene


def test_the_hash_covers_all_data_that_training_reads(capture_folder):
    scene = load_scene(str(capture_folder))
    digest = hash_data(scene)
    assert len(digest) == 64
    assert hash_data(load_scene(str(capture_folder))) == digest
    views = scene.train
    pose = views.cameras.camtoworld.at[0, 0, 3].add(1e-6)
    for changed in (
        views.replace(rgb=views.rgb.at[-1, -1, -1, -1].add(1)),
        views.replace(weight=views.weight.at[0, 0, 0].set(0)),
        views.replace(cameras=views.cameras.replace(camtoworld=pose)),
    ):
        assert hash_data(dataclasses.replace(scene, train=changed)) != digest
    # Training does not read held-out photographs.
    assert hash_data(dataclasses.replace(scene, test=None)) == digest


def test_a_manifest_can_load_the_scene_again(capture_folder, monkeypatch):
    monkeypatch.chdir(capture_folder.parent)
    about = about_scene(load_scene(capture_folder.name), {"downscale": 1})
    again = load_scene(about["scene"], **about["load_options"])
    assert about["scene"] == str(capture_folder.resolve())
    assert hash_data(again) == about["data_sha256"]


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_commit_is_that_of_the_package(tmp_path):
    def git(*args):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        subprocess.run(["git", "-C", tmp_path, *identity, *args], check=True, capture_output=True)

    package, installed = tmp_path / "package", tmp_path / ".venv" / "package"
    for folder in (package, installed):
        folder.mkdir(parents=True)
        (folder / "a.py").write_text("a")
    assert git_commit(package) == (None, None)
    git("init")
    assert git_commit(package) == (None, None)  # nothing is committed yet
    git("add", "package")
    git("commit", "-m", "a")
    commit, changed = git_commit(package)
    assert len(commit) == 40 and not changed
    (package / "a.py").write_text("b")
    assert git_commit(package) == (commit, True)
    # The checkout of another project that contains the environment.
    assert git_commit(installed) == (None, None)


def test_missing_git_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_commit(tmp_path) == (None, None)


def test_a_run_that_another_commit_continues_warns(tmp_path, monkeypatch):
    commits = iter(["a" * 40, "a" * 40, "b" * 40, None])
    monkeypatch.setattr(manifest, "git_commit", lambda _: (next(commits), False))
    for _ in range(2):
        manifest.write_manifest(tmp_path, {})
    with pytest.warns(
        UserWarning, match="started by commit aaaaaaaaa and continues with bbbbbbbbb"
    ):
        manifest.write_manifest(tmp_path, {})
    manifest.write_manifest(tmp_path, {})


def test_a_resumed_run_does_not_say_what_its_last_process_used(tmp_path):
    for resumed in (False, True):
        manifest.write_manifest(tmp_path, {}, {"baseline": 2.0}, resumed=resumed)
        found = json.loads((tmp_path / manifest.NAME).read_text())
        assert found["resumed"] == resumed and found["finished"]
        assert (found["core_seconds"] is None) == (found["peak_bytes"] is None) == resumed


def test_the_hash_of_target_views_covers_their_cameras(capture_folder):
    scene = load_scene(str(capture_folder))
    known = manifest.hash_targets(scene)
    turned = scene.test.replace(
        cameras=scene.test.cameras.replace(camtoworld=-scene.test.cameras.camtoworld)
    )
    assert known == manifest.hash_targets(load_scene(str(capture_folder)))
    assert manifest.hash_targets(dataclasses.replace(scene, test=turned)) != known
    assert manifest.hash_targets(dataclasses.replace(scene, test=None)) is None


def test_a_sweep_writes_a_manifest(capture_folder, tmp_path, monkeypatch):
    flags.FLAGS(["sweep"])
    started = {}

    def stub(scene, preset, arms, seeds, folder, *, seconds, **options):
        started.update(json.loads((tmp_path / "out" / "manifest.json").read_text()))
        seconds["baseline_0"] = 1.5
        return SweepOutcome({}, {}, {})

    monkeypatch.setattr(scene_sweeps, "run_sweep", stub)
    monkeypatch.setattr(scene_sweeps, "write_sweep", lambda *_: None)
    monkeypatch.setattr("jaxcloseup.app.report.sweep_tables.print_sweep", lambda *_: None)
    given = {"output_dir": str(tmp_path / "out"), "scenes": [str(capture_folder)], "downscale": 1}
    with flagsaver.flagsaver(compilation_cache="", arms=["control"], seeds=2, **given):
        program.main(["sweep"])
    assert started["finished"] is False and started["seconds"] is None
    after = json.loads((tmp_path / "out" / "manifest.json").read_text())
    name = capture_folder.name
    assert after["finished"] and after["seconds"] == {name: {"baseline_0": 1.5}}
    assert after["seeds"] == [0, 1] and after["arms"] == ["control"]
    options = {"downscale": 1, "half_pixel": False, "format": None, "split": "given"}
    assert after["scenes"][name]["load_options"] == options
    assert after["scenes"][name]["data_sha256"] == hash_data(load_scene(str(capture_folder)))
