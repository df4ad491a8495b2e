"""Weights of detail from runs, and what their errors are compared with."""

import dataclasses
import functools
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.benchmarks import teach
from jaxcloseup.app.score.expected_errors import compare_errors, error_tenths, rank_errors
from jaxcloseup.app.score.targets import Target
from jaxcloseup.detail import weights as detail_weights
from jaxcloseup.detail.add import Detailed
from jaxcloseup.detail.features import FEATURES
from jaxcloseup.detail.learn import learn_weights
from jaxcloseup.detail.weights import known_weights


def test_runs_of_two_scenes_teach_a_network_each(kept, tmp_path, monkeypatch, capsys):
    names, open_run = iter(("first", "second")), teach.open_run

    def renamed(folder, stage):
        run = open_run(folder, stage)
        return run._replace(scene=dataclasses.replace(run.scene, name=next(names)))

    monkeypatch.setattr(teach, "open_run", renamed)
    monkeypatch.setattr(teach, "STAGE", "closeup")
    quickly = functools.partial(learn_weights, steps=(20, 20))
    monkeypatch.setattr(teach, "learn_weights", quickly)
    for name in ("a", "b"):
        shutil.copytree(kept, tmp_path / "all" / name)
    with jax.numpy_dtype_promotion("standard"):
        teach.run(tmp_path)
    out = capsys.readouterr().out
    for name in ("first", "second"):
        assert f"{name}, which its network never saw: " in out
    monkeypatch.setattr(detail_weights, "KNOWN", tmp_path / "detail_weights.npz")
    detail_weights._read_known.cache_clear()
    try:
        weights = known_weights()
        assert weights.mixing.center.shape == (2, FEATURES)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    finally:
        detail_weights._read_known.cache_clear()


def test_one_scene_has_no_test(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(teach, "STAGE", "closeup")
    shutil.copytree(kept, tmp_path / "all" / "a")
    with (
        pytest.raises(SystemExit, match="must hold runs of two scenes or more"),
        jax.numpy_dtype_promotion("standard"),
    ):
        teach.run(tmp_path)
    assert not list(tmp_path.glob("*.npz"))


def test_tenths_hold_as_many_pixels_by_what_is_expected():
    rng = np.random.default_rng(0)
    expected = rng.uniform(0, 1, 1000)
    weight = np.where(np.arange(1000) < 900, 1.0, 0.0)
    tenths = error_tenths(expected, 2 * expected, weight)
    counted = np.sort(expected[:900]).reshape(10, 90).mean(axis=1)
    np.testing.assert_allclose([row["expected"] for row in tenths], counted, atol=0.01)
    for row in tenths:
        assert row["actual"] == pytest.approx(2 * row["expected"])
    assert not error_tenths(expected, expected, 0 * weight)
    assert error_tenths(np.ones(3), np.zeros(3), np.ones(3))[-1] == {"expected": 1, "actual": 0}


def test_errors_are_compared_where_they_are_expected_and_without_exposure():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (8, 10, 3)).astype(np.float32)
    error = np.full((9, 12), 0.1, np.float32)
    error[:, :5] = np.nan
    rgb = np.pad(0.5 * truth + 0.1, ((0, 1), (0, 2), (0, 0)))
    rgb[:8, :5] = 0.3  # nothing is expected there, but it changes the fit
    weight = np.ones((8, 10), np.float32)
    weight[:, :5] = 0
    target = Target("view", SimpleNamespace(), *map(jnp.asarray, (truth, weight, weight)))
    seen = Detailed(jnp.asarray(rgb), None, None, jnp.asarray(error))
    found = compare_errors(lambda camera: seen, [target])
    tenths = found["errors"]
    assert all(row["expected"] == pytest.approx(0.1) for row in tenths)
    assert all(row["actual"] < 1e-5 for row in tenths)
    assert "ause" not in found  # all expect the same
    assert compare_errors(lambda camera: seen, []) == {"errors": []}


def test_expected_errors_are_ranked_by_area_and_correlation():
    rng = np.random.default_rng(0)
    actual = rng.uniform(0, 1, 20_000)
    knows = rank_errors(3 * actual + 1, actual)
    assert knows["ause"] == pytest.approx(0, abs=1e-9)
    assert knows["pearson"] == pytest.approx(1)
    # Of means a + b with the same variance, one of which is known: a correlation of 1 / sqrt(2).
    other = rng.uniform(0, 1, 20_000)
    half = rank_errors(actual, actual + other)
    assert half["pearson"] == pytest.approx(0.5**0.5, abs=0.01)
    assert 0.05 < half["ause"] < rank_errors(other, actual)["ause"]
    assert not rank_errors(np.ones(5), actual[:5])
    assert not rank_errors(np.empty(0), np.empty(0))
