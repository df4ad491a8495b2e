"""LPIPS against the reference implementation, and weights as PyTorch writes them."""

import json
import pathlib
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.lpips import BACKBONES, LpipsError, LpipsWeights, layer_shapes, load_lpips, lpips
from jaxcloseup.torch_file import TorchFileError, read_tensors


DATA = pathlib.Path(__file__).parent / "data"
GOLDEN = pathlib.Path(__file__).parents[2] / "shared" / "golden" / "lpips_golden.json"


@pytest.fixture(scope="module")
def random_weights():
    """Weights of both backbones, drawn as they were for the golden values."""

    def draw(backbone):
        rng = np.random.default_rng(20250315)
        kernels, heads = layer_shapes(backbone)
        convolutions = []
        for shape in kernels:
            kernel = rng.standard_normal(shape) * np.sqrt(2 / np.prod(shape[1:]))
            bias = 0.05 * rng.standard_normal(shape[0])
            convolutions.append((jnp.float32(kernel), jnp.float32(bias)))
        linear = tuple(jnp.float32(rng.uniform(0, 1, (1, c, 1, 1)).reshape(-1)) for c in heads)
        return LpipsWeights(tuple(convolutions), linear, backbone)

    return {backbone: draw(backbone) for backbone in BACKBONES}


compiled = jax.jit(lpips)


def pair(rng, height, width):
    a = rng.uniform(0, 1, (height, width, 3))
    b = np.clip(a + 0.15 * rng.standard_normal((height, width, 3)), 0, 1)
    return jnp.float32(a), jnp.float32(b)


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.skipif(not GOLDEN.exists(), reason="the golden values are not on this machine")
def test_equals_the_reference_implementation(random_weights, backbone):
    rng = np.random.default_rng(7)
    for row in json.loads(GOLDEN.read_text())[backbone]:
        images = pair(rng, row["height"], row["width"])
        found = compiled(random_weights[backbone], *images)
        assert abs(float(found) - row["lpips"]) < 1e-4


def test_a_batch_equals_its_images_one_by_one(random_weights):
    rng = np.random.default_rng(0)
    a, b = (
        jnp.stack(images)
        for images in zip(pair(rng, 40, 33), pair(rng, 40, 33), pair(rng, 40, 33), strict=True)
    )
    weights = random_weights["alex"]
    together = compiled(weights, a, b)
    alone = [compiled(weights, a[i], b[i]) for i in range(3)]
    np.testing.assert_allclose(together, alone, rtol=1e-5)
    np.testing.assert_allclose(compiled(weights, b, a), together, rtol=1e-5)  # symmetric
    np.testing.assert_array_equal(lpips(weights, a, a), 0)


def test_gradients_are_finite_where_all_features_are_zero(random_weights):
    """Biases far below 0 make all features 0."""
    weights = random_weights["alex"]
    kernel, bias = weights.convolutions[0]
    dead = weights.replace(convolutions=((kernel, bias - 1e3), *weights.convolutions[1:]))
    a, b = pair(np.random.default_rng(0), 40, 33)
    gradient = jax.jit(jax.grad(lambda image: lpips(dead, image, b)))(a)
    assert jnp.all(jnp.isfinite(gradient))


def test_small_images_are_refused(random_weights):
    with pytest.raises(ValueError, match="31 pixels a side"):
        lpips(random_weights["alex"], jnp.zeros((30, 40, 3)), jnp.zeros((30, 40, 3)))


# Both files hold {"weight": arange(6) as [2, 3], "turned": its transpose, one storage for both,
# "half": [0.5, -2] of 16 bits, "empty": [0, 3]}, as PyTorch 2.13 wrote them in either format.
@pytest.mark.parametrize("name", ["tensors_zip.pth", "tensors_legacy.pth"])
def test_tensors_are_read_as_pytorch_wrote_them(name):
    found = read_tensors(DATA / name)
    weight = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.testing.assert_array_equal(found["weight"], weight)
    np.testing.assert_array_equal(found["turned"], weight.T)
    np.testing.assert_array_equal(found["half"], np.float16([0.5, -2]))
    assert found["half"].dtype == np.float16
    assert found["empty"].shape == (0, 3)


@pytest.mark.parametrize("name", ["tensors_zip.pth", "tensors_legacy.pth"])
def test_truncated_files_are_refused(tmp_path, name):
    data = (DATA / name).read_bytes()
    for size in (0, 10, len(data) // 2, len(data) - 8):
        path = tmp_path / "cut.pth"
        path.write_bytes(data[:size])
        with pytest.raises(TorchFileError, match="not a whole file"):
            read_tensors(path)


def test_a_file_cannot_run_code(tmp_path):
    path = tmp_path / "evil.pth"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("evil/data.pkl", b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(TorchFileError, match=r"it holds os\.system"):
        read_tensors(path)


def test_errors_name_the_file_that_is_missing(tmp_path, monkeypatch):
    with pytest.raises(LpipsError, match=r"vgg16-\*\.pth"):
        load_lpips("vgg", tmp_path)
    monkeypatch.setenv("JAXCLOSEUP_LPIPS", str(tmp_path))
    with pytest.raises(LpipsError, match=str(tmp_path)):
        load_lpips("alex")
    for file in ("vgg16-1.pth", "vgg.pth"):
        (tmp_path / file).write_bytes((DATA / "tensors_zip.pth").read_bytes())
    with pytest.raises(LpipsError, match=r"vgg16-1\.pth does not hold the convolutions"):
        load_lpips("vgg", tmp_path)
