"""LPIPS against the reference implementation, and weights as PyTorch writes them."""

import io
import json
import os
import pathlib
import pickle
import sys
import types
import zipfile
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcloseup.io import torch_file
from jaxcloseup.io.torch_file import TorchFileError, read_tensors
from jaxcloseup.metrics.perceptual import (
    BACKBONES,
    LpipsError,
    LpipsWeights,
    layer_shapes,
    load_lpips,
    lpips,
)


DATA = pathlib.Path(__file__).parents[1] / "data"
GOLDEN = pathlib.Path(__file__).parents[3] / "shared" / "golden" / "lpips_golden.json"


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


def test_what_a_file_says_is_no_command_to_the_terminal(tmp_path):
    data = (DATA / "tensors_legacy.pth").read_bytes()
    path = tmp_path / "a.pth"
    path.write_bytes(data.replace(b"_rebuild_tensor_v2", b"_rebuild\x1b[31mtenso"))
    with pytest.raises(TorchFileError, match=r"it holds torch\._utils\._rebuild\\x1b\[31mtenso"):
        read_tensors(path)


def zipped(path, pickled, storage=b""):
    """Write a file in PyTorch's format of today."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/data/0", storage)
    return path


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (b"cos\nsystem\n(S'true'\ntR.", r"it holds os\.system"),
        # NumPy's integers, as strides, would wrap around in the check of bounds.
        (b"ctorch\nLongStorage\n(I4611686018427387905\ntR.", "not callable"),
    ],
)
def test_a_pickle_calls_nothing_but_what_rebuilds_tensors(tmp_path, call, message):
    with pytest.raises(TorchFileError, match=message):
        read_tensors(zipped(tmp_path / "evil.pth", call))


def tensor_file(path, arguments, *, name="weight", size=6):
    """Write a file of one tensor of `size` numbers, rebuilt with `arguments` after its storage."""

    class Storage(str):
        pass

    class Pickler(pickle.Pickler):
        def persistent_id(self, found):
            return ("storage", Float, "0", "cpu", size) if isinstance(found, Storage) else None

    # The pickle names what the reader looks up, without PyTorch.
    Float, Rebuilt = (type(kind, (), {}) for kind in ("FloatStorage", "_rebuild_tensor_v2"))
    Float.__module__, Rebuilt.__module__ = "torch", "torch._utils"
    Rebuilt.__reduce__ = lambda self: (Rebuilt, (Storage(), *arguments))
    module, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    module.FloatStorage, utils._rebuild_tensor_v2 = Float, Rebuilt
    data = io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": module, "torch._utils": utils}):
        Pickler(data, protocol=2).dump({name: Rebuilt()})
    return zipped(path, data.getvalue(), np.arange(size, dtype=np.float32).tobytes())


def test_no_tensor_reaches_beyond_its_storage(tmp_path):
    path = tmp_path / "weights.pth"
    found = read_tensors(tensor_file(path, (1, (2, 2), (2, 1))))
    np.testing.assert_array_equal(found["weight"], [[1, 2], [3, 4]])
    for arguments in (
        (0, (7,), (1,)),
        (3, (2, 2), (2, 1)),
        (0, (2,), (2**62,)),
        (0, (2,), (-1,)),
        (-1, (2,), (1,)),
        (0, (2**40,), (0,)),
        (0, (6.0,), (1,)),
        (0, (6,), (1, 1)),
        (0, (True,), (1,)),
    ):
        with pytest.raises(TorchFileError, match="not a whole file"):
            read_tensors(tensor_file(path, arguments))


def test_a_pickle_cannot_change_a_tensor_after_its_check(tmp_path):
    path = tensor_file(tmp_path / "weights.pth", (0, (2,), (1,)))
    with zipfile.ZipFile(path) as archive:
        data = archive.read("archive/data.pkl")
    assert data.count(b"Rq") == 1  # the call that makes the tensor; then its state is set
    place = data.index(b"Rq") + 1
    data = data[:place] + b"}(U\x06offsetJ\xf0\xff\xff\xffub" + data[place:]
    with pytest.raises(TorchFileError, match="not of whole numbers"):
        read_tensors(zipped(path, data, bytes(24)))


def test_files_without_end_or_with_strange_names_are_refused(tmp_path, monkeypatch):
    with pytest.raises(TorchFileError, match="Not an ordinary file"):
        read_tensors("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(TorchFileError, match="Not an ordinary file"):
        read_tensors(tmp_path / "pipe")
    whole = (0, (2,), (1,))
    with pytest.raises(TorchFileError, match="not a dictionary of tensors"):
        read_tensors(tensor_file(tmp_path / "vgg16-1.pth", whole, name=3))
    for name in ("features.abc.weight", "features.weight", f"features.{'9' * 5000}.weight"):
        for file in ("vgg16-1.pth", "vgg.pth"):
            tensor_file(tmp_path / file, whole, name=name)
        with pytest.raises(LpipsError, match="does not hold the convolutions"):
            load_lpips("vgg", tmp_path)
    monkeypatch.setattr(torch_file, "LARGEST_FILE", 10)
    with pytest.raises(TorchFileError, match="More than "):
        read_tensors(tensor_file(tmp_path / "large.pth", whole))


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
