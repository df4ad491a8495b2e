"""Weights of detail: what evidence teaches, and those that come with the package."""

import functools

import jax
import numpy as np
import pytest

from jaxcloseup.captures.load import DRAWN_SCENES
from jaxcloseup.detail import weights as detail_weights
from jaxcloseup.detail.features import FEATURES
from jaxcloseup.detail.learn import Evidence, learn_weights
from jaxcloseup.detail.weights import CONTRAST, blend, expected_errors, known_weights, write_known


# Made-up evidence is simple, so few steps teach it.
learn_quickly = functools.partial(learn_weights, steps=(250, 300))


def made_up(share, count=20_000, seed=0):
    """Evidence whose true share of the gathered residual is `share(feature)`, plus noise."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 1, count)
    features = np.stack([np.ones(count), x, x**2], axis=-1)
    gathered = rng.normal(0, 0.1, (count, 3))
    own = share(x)[:, None] * gathered + (0.01 + 0.03 * x)[:, None] * rng.normal(0, 1, (count, 3))
    images = features, gathered / CONTRAST, rng.normal(0, 0.1, (count, 3)), own, np.ones(count)
    return Evidence(*(image.astype(np.float32) for image in images)), x


@pytest.mark.parametrize(
    "share", [lambda x: 0.2 + 0.6 * x, lambda x: 1 / (1 + np.exp(12 * (x - 0.5)))]
)
def test_weights_are_the_share_that_is_there(share):
    weights = learn_quickly({f"scene {seed}": [made_up(share, seed=seed)[0]] for seed in range(3)})
    other, x = made_up(share, seed=3)
    mixed, predicted = map(np.asarray, blend(weights, *other[:3]))
    added = predicted[:, None] * mixed
    expected = share(x)[:, None] * CONTRAST * other.residual
    # Colors are noise here: what is added is the share of the residual.
    assert np.abs(added - expected).mean() < 0.1 * np.abs(expected).mean()

    # The mean of |z| is sqrt(2 / pi) of the deviation: of the noise, and of what the render lacks.
    noise = 0.01 + 0.03 * x
    deviations = np.hypot(0.1 * share(x), noise), noise
    guesses = np.asarray(expected_errors(weights, other[0])).T
    for guess, deviation in zip(guesses, deviations, strict=True):
        assert guess == pytest.approx(np.sqrt(2 / np.pi) * deviation, rel=0.25)
        assert guess.mean() == pytest.approx(np.sqrt(2 / np.pi) * deviation.mean(), rel=0.03)


def test_colors_are_taken_where_they_are_right_and_the_residual_elsewhere():
    rng, count = np.random.default_rng(0), 40_000
    exact = rng.uniform(size=count) < 0.5
    own, noise = rng.normal(0, 0.1, (2, count, 3))
    colors = np.where(exact[:, None], own, noise)
    residual = np.where(exact[:, None], noise, own) / CONTRAST
    images = exact[:, None] * 1.0, residual, colors, own, np.ones(count)
    found = Evidence(*(image.astype(np.float32) for image in images))
    weights = learn_quickly({"scene": [found]})
    mixed, share = blend(weights, *found[:3])
    assert np.abs(np.asarray(mixed) - own).mean() < 0.1 * np.abs(own).mean()
    assert float(share.min()) > 0.9


def test_weights_stay_in_their_range_and_need_evidence():
    found, _ = made_up(lambda x: 3 * x - 1)
    _, predicted = blend(learn_quickly({"scene": [found]}), *found[:3])
    assert 0 <= float(predicted.min()) < 0.05 and 0.95 < float(predicted.max()) <= 1
    none = found._replace(weight=0 * found.weight)
    with pytest.raises(ValueError, match="no photograph shows anything of the scenes other than b"):
        learn_quickly({"a": [none], "b": [found]})


def test_what_points_away_from_the_truth_is_not_added():
    def share(x):
        return np.where(x < 0.4, -0.3, 0.8)

    found = {}
    for seed in range(3):
        one, x = made_up(share, seed=seed)
        found[f"scene {seed}"] = [one._replace(colors=CONTRAST * one.residual)]
    _, predicted = map(np.asarray, blend(learn_quickly(found), *found["scene 2"][0][:3]))
    assert predicted[x < 0.35].max() < 0.05 and predicted[x > 0.45].min() > 0.6


def test_a_scene_is_judged_by_a_network_that_never_saw_it(tmp_path, monkeypatch):
    """Two scenes have all of the residual, a third has none, and one pixel counts as much there."""
    shares = {"a": 1.0, "b": 1.0, "none": 0.0}
    found = {
        name: [made_up(lambda x, share=share: share + 0 * x, seed=seed)[0]]
        for seed, (name, share) in enumerate(shares.items())
    }
    path = tmp_path / "weights.npz"
    write_known(path, list(found), learn_quickly(found))
    monkeypatch.setattr(detail_weights, "KNOWN", path)
    detail_weights._read_known.cache_clear()

    def share(unseen):
        rows = found["a"][0][:3]
        return float(np.mean(blend(known_weights(unseen), *rows)[1]))

    try:
        assert share("none") > 0.97 and share("a") < 0.9 and share("b") < 0.9
        assert share("another") == share(None) and share("a") < share(None) < share("none")
    finally:
        detail_weights._read_known.cache_clear()


def test_built_in_scenes_taught_the_weights_that_come_with_the_package():
    """All but the statue did, which all networks therefore judge."""
    names, weights = detail_weights._read_known()
    assert sorted(names) == sorted(set(DRAWN_SCENES) - {"statue"})
    assert known_weights("statue") is weights
    for networks in (weights.mixing, weights.errors):
        assert networks.center.shape == networks.scale.shape == (len(names), FEATURES)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(networks))
    own = known_weights(names[2])
    np.testing.assert_array_equal(own.errors.center, weights.errors.center[2:3])
