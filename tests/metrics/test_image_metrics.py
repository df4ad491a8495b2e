import functools

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxcloseup.metrics.image_metrics import cc_psnr, fit_colors, psnr, quantize, ssim
from jaxcloseup.native import library


METRICS = {"psnr": psnr, "ssim": ssim, "cc_psnr": cc_psnr}


@pytest.fixture
def pair():
    """A smooth image and a noisy copy of it, 14x17."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.uniform(0.1, 0.9, (4, 5, 3)), (17, 14), interpolation=cv2.INTER_CUBIC)
    noisy = image + 0.1 * rng.normal(size=image.shape)
    return tuple(np.clip(i, 0, 1).astype(np.float32) for i in (image, noisy))


@pytest.fixture
def weight():
    return np.random.default_rng(1).uniform(0, 1, (14, 17)).astype(np.float32)


def test_quantize_is_what_a_png_holds(pair, tmp_path):
    image = np.array([[[-0.1, 1.2, 0.5], [0.499 / 255, 0.501 / 255, 254.4 / 255]]], np.float32)
    expected = np.array([[[0, 255, 128], [0, 1, 254]]]) / 255
    np.testing.assert_allclose(quantize(image), expected, rtol=1e-6)
    stored = np.asarray(jnp.round(quantize(pair[1]) * 255).astype(jnp.uint8))
    cv2.imwrite(str(tmp_path / "a.png"), stored)
    loaded = cv2.imread(str(tmp_path / "a.png")).astype(np.float32) / 255
    np.testing.assert_allclose(loaded, quantize(pair[1]), rtol=2e-7)


def test_psnr_closed_forms():
    image = jnp.full((3, 4, 3), 0.25)
    np.testing.assert_allclose(psnr(image, image + 0.1), 20, rtol=1e-5)
    np.testing.assert_allclose(psnr(image, image + 0.5), -20 * np.log10(0.5), rtol=1e-5)
    assert psnr(image, image) == jnp.inf
    # Half of the pixels differ by 0.1, and they have three quarters of the weight.
    target = image.at[:, :2].add(0.1)
    weight = jnp.ones((3, 4)).at[:, :2].set(3)
    np.testing.assert_allclose(psnr(image, target), 20 + 10 * np.log10(2), rtol=1e-5)
    np.testing.assert_allclose(
        psnr(image, target, weight=weight), 20 + 10 * np.log10(4 / 3), rtol=1e-5
    )
    assert psnr(image, target, weight=jnp.ones((3, 4)).at[:, :2].set(0)) == jnp.inf


def test_psnr_agrees_with_opencv(pair):
    a, b = (np.asarray(jnp.round(quantize(i) * 255).astype(jnp.uint8)) for i in pair)
    np.testing.assert_allclose(psnr(*map(quantize, pair)), cv2.PSNR(a, b), rtol=1e-5)


def test_ssim_agrees_with_the_oracle(pair, weight):
    expected = reference.ssim_map(*pair)
    assert expected.mean() < 0.95
    np.testing.assert_allclose(ssim(*pair), expected.mean(), atol=1e-5)
    centers = weight[5:-5, 5:-5]
    np.testing.assert_allclose(
        ssim(*pair, weight=weight), (expected.mean(-1) * centers).sum() / centers.sum(), atol=1e-5
    )


def test_the_gradient_of_ssim_is_the_finite_difference_of_the_oracle(pair, weight):
    """By both images and the weights, along drawn directions."""
    rng = np.random.default_rng(2)
    inputs = [np.float64(x) for x in (*pair, weight)]
    along = [rng.normal(size=x.shape) for x in inputs]

    def of_oracle(*values):
        centers = values[2][5:-5, 5:-5]
        return np.sum(reference.ssim_map(*values[:2]).mean(-1) * centers) / np.sum(centers)

    @jax.jit
    def gradients(*inputs):
        return jax.grad(lambda *x: ssim(*x[:2], weight=x[2]), argnums=(0, 1, 2))(*inputs)

    for number, gradient in enumerate(gradients(*map(np.float32, inputs))):
        moved = [
            [x + sign * 1e-5 * along[k] * (k == number) for k, x in enumerate(inputs)]
            for sign in (1, -1)
        ]
        expected = (of_oracle(*moved[0]) - of_oracle(*moved[1])) / 2e-5
        np.testing.assert_allclose(np.sum(gradient * along[number]), expected, rtol=2e-3)


@pytest.mark.skipif(not library.available(), reason=str(library.missing()))
@pytest.mark.parametrize("size", [(11, 11), (12, 138), (40, 301)])
def test_the_library_compares_several_images_as_jax_does(size):
    """One window, a block of values and one more, several blocks; renders brighter than white."""
    rng = np.random.default_rng(4)
    image = rng.uniform(0, 1, (2, *size, 3)).astype(np.float32)
    target = np.float32(image + 0.2 * rng.standard_normal(image.shape))
    target[1, :, :60] = image[1, :, :60] = 3.7
    weight = rng.uniform(0, 1, size).astype(np.float32)

    def both(image, target):
        called = functools.partial(ssim, weight=weight)
        return jax.value_and_grad(called, argnums=(0, 1))(image, target)

    ours = jax.jit(jax.vmap(both))(image, target)
    centers = weight[5:-5, 5:-5]
    with jax.enable_x64(True):
        wide = [jnp.asarray(x, jnp.float64) for x in (image, target)]
        theirs = jax.jit(jax.vmap(both))(*wide)
    expected = [
        np.sum(reference.ssim_map(a, b).mean(-1) * centers) / np.sum(centers)
        for a, b in zip(image, target, strict=True)
    ]
    np.testing.assert_allclose(ours[0], expected, atol=1e-5)
    for one, other in zip(ours[1], theirs[1], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3 * np.abs(other).max())


def test_ssim_calls_the_library_on_cpus_only(pair):
    traced = jax.jit(ssim).trace(*pair)
    assert "jaxcloseup_ssim" not in traced.lower(lowering_platforms=("cuda",)).as_text()
    called = "jaxcloseup_ssim" in traced.lower(lowering_platforms=("cpu",)).as_text()
    assert called == library.available()


def test_ssim_without_any_weight_is_none_and_moves_nothing(pair):
    value, gradient = jax.value_and_grad(
        lambda image: jnp.nan_to_num(ssim(image, pair[1], weight=jnp.zeros((14, 17))), nan=2.0)
    )(pair[0])
    assert value == 2 and not np.any(gradient)


def test_ssim_closed_forms(pair):
    np.testing.assert_allclose(ssim(pair[0], pair[0]), 1, atol=1e-6)
    a, b = jnp.full((11, 11, 3), 0.2), jnp.full((11, 11, 3), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)  # nothing but luminance differs
    np.testing.assert_allclose(ssim(a, b), expected, rtol=1e-4)


def test_cc_psnr_undoes_an_affine_change(pair):
    matrix = np.array([[0.7, 0.1, 0], [0, 0.6, 0.1], [0.05, 0, 0.8]], np.float32)
    changed = pair[0] @ matrix.T + np.float32(0.05)
    assert psnr(changed, pair[0]) < 25
    assert cc_psnr(changed, pair[0]) > 90


def test_cc_psnr_agrees_with_least_squares(pair, weight):
    image, target = pair[0] * np.array([0.5, 0.8, 1.0], np.float32), pair[1]
    rows = np.concatenate([image, np.ones((14, 17, 1))], -1).reshape(-1, 4)
    scale = np.sqrt(weight.reshape(-1, 1).astype(np.float64))
    fit = np.linalg.lstsq(rows * scale, target.reshape(-1, 3) * scale, rcond=None)[0]
    squared = (np.clip(rows @ fit, 0, 1) - target.reshape(-1, 3)) ** 2
    expected = -10 * np.log10((squared.mean(-1) * weight.ravel()).sum() / weight.sum())
    result = cc_psnr(image, target, weight=weight)
    np.testing.assert_allclose(result, expected, rtol=1e-4)
    assert result > psnr(image, target, weight=weight) + 1


@pytest.mark.parametrize("ridge", [1e-4, 0.1, 1e6])
def test_a_ridge_holds_colors_back(pair, weight, ridge):
    """The oracle is least squares with extra rows for the distance from the identity."""
    image, target = (np.asarray(x, np.float64).reshape(-1, 3) for x in pair)
    share = weight.ravel() / weight.sum()
    mean = share @ image
    rows = np.concatenate([image - mean, np.ones((len(image), 1))], -1) * np.sqrt(share)[:, None]
    rows = np.concatenate([rows, np.sqrt(ridge) * np.eye(4)])
    no_change = np.concatenate([np.eye(3), mean[None]])
    wanted = np.concatenate([target * np.sqrt(share)[:, None], np.sqrt(ridge) * no_change])
    fit = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    matrix, offset = fit_colors(*pair, weight, ridge=ridge)
    np.testing.assert_allclose(matrix, fit[:3], atol=2e-4)
    np.testing.assert_allclose(offset, fit[3] - mean @ fit[:3], atol=2e-4)


def test_cc_psnr_of_a_large_image_is_that_of_64_bits():
    """Naive sums of 32 bits over areas of one nearly gray color lose what tells it from gray."""
    rng = np.random.default_rng(0)
    palette = rng.uniform(0.1, 0.95, (12, 1)) + 0.01 * rng.standard_normal((12, 3))
    chosen = np.kron(rng.integers(0, 12, (9, 16)), np.ones((60, 60), int))
    chosen[:, :480] = 0
    image = palette[chosen]
    target = np.clip(image + 0.02 * rng.standard_normal(image.shape), 0, 1)
    columns = np.column_stack([image.reshape(-1, 3), np.ones(540 * 960)])
    change = np.linalg.lstsq(columns, target.reshape(-1, 3), rcond=None)[0]
    error = np.clip(columns @ change, 0, 1) - target.reshape(-1, 3)
    found = jax.jit(cc_psnr)(jnp.asarray(image, jnp.float32), jnp.asarray(target, jnp.float32))
    assert found == pytest.approx(-10 * np.log10(np.mean(error**2)), abs=0.01)


def test_cc_psnr_of_degenerate_colors(pair):
    gray = jnp.repeat(pair[0][..., :1], 3, axis=-1)
    assert cc_psnr(gray, 0.5 * gray) > 100  # nothing but rounding is left
    flat = jnp.full_like(gray, 0.3)
    expected = -10 * np.log10(((pair[1] - pair[1].mean((0, 1))) ** 2).mean())
    np.testing.assert_allclose(cc_psnr(flat, pair[1]), expected, rtol=1e-4)


@pytest.mark.parametrize("name", METRICS)
def test_pixels_of_weight_zero_do_not_count(pair, weight, name):
    metric, (image, target) = METRICS[name], pair
    outside = weight < 0.5
    inside = np.where(outside, np.float32(0), weight)
    changed = np.where(outside[..., None], np.float32(0.5), image)
    if name != "ssim":  # a window reads its neighbors, whatever they weigh
        expected = metric(image, target, weight=inside)
        np.testing.assert_allclose(metric(changed, target, weight=inside), expected, rtol=1e-4)
    even = metric(image, target, weight=np.full_like(weight, 0.1))
    np.testing.assert_allclose(even, metric(image, target), rtol=1e-5)
    assert jnp.isnan(metric(image, target, weight=np.zeros_like(weight)))


@pytest.mark.parametrize("name", METRICS)
def test_jit_and_vmap(pair, weight, name):
    images = np.stack([pair[0], pair[0] ** 2, pair[0] * np.float32(0.5)])
    targets, weights = np.stack([pair[1]] * 3), np.stack([weight, weight * 2, np.ones_like(weight)])
    batched = jax.jit(jax.vmap(lambda a, b, w: METRICS[name](a, b, weight=w)))
    single = [
        METRICS[name](a, b, weight=w) for a, b, w in zip(images, targets, weights, strict=True)
    ]
    np.testing.assert_allclose(batched(images, targets, weights), single, rtol=1e-4)


@pytest.mark.parametrize("name", METRICS)
@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_is_measured_in_single(name, dtype):
    """A sum over 90,000 pixels overflows 16 bits."""
    rng = np.random.default_rng(3)
    image, target = (jnp.asarray(rng.uniform(size=(300, 300, 3)), dtype) for _ in range(2))
    found = METRICS[name](image, target)
    assert found.dtype == jnp.float32
    single = METRICS[name](image.astype(jnp.float32), target.astype(jnp.float32))
    np.testing.assert_array_equal(found, single)


def test_wrong_inputs_are_refused(pair, weight):
    with pytest.raises(ValueError, match="SSIM needs 11 pixels a side"):
        ssim(pair[0][:10], pair[1][:10])
    for metric in METRICS.values():
        with pytest.raises(AssertionError):
            metric(pair[0], pair[1][:, :16])
        with pytest.raises(AssertionError):
            metric(*pair, weight=weight[:13])
        with pytest.raises(AssertionError):
            metric(*((i * 255).astype(np.uint8) for i in pair))
