"""LPIPS: the distance between two images in the features of a network trained on photographs.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018,
equation 1, version 0.1 with its linear heads on VGG-16 or AlexNet. The function is pure. NumPy
alone reads its weights from the public PyTorch files.
"""

import importlib.util
import os
import pathlib
import re
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from jaxcloseup.geometry.numerics import safe_norm
from jaxcloseup.io.torch_file import TorchFileError, read_tensors


# Means and deviations of ImageNet's colors, for images in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)

# Layers in order: "conv" with channels, size, stride and padding, and a ReLU after it; "max"
# pooling with size and stride; "tap" where features enter the distance.
_VGG_BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
_LAYERS: dict[str, list[tuple[Any, ...]]] = {
    "vgg": [
        layer
        for i, block in enumerate(_VGG_BLOCKS)
        for layer in [
            *([("max", 2, 2)] if i else []),
            *(("conv", channels, 3, 1, 1) for channels in block),
            ("tap",),
        ]
    ],
    "alex": [
        ("conv", 64, 11, 4, 2),
        ("tap",),
        ("max", 3, 2),
        ("conv", 192, 5, 1, 2),
        ("tap",),
        ("max", 3, 2),
        ("conv", 384, 3, 1, 1),
        ("tap",),
        ("conv", 256, 3, 1, 1),
        ("tap",),
        ("conv", 256, 3, 1, 1),
        ("tap",),
    ],
}
BACKBONES = tuple(_LAYERS)
SMALLEST = {"vgg": 16, "alex": 31}  # pixels a side that the last pooling needs

FOLDER_VARIABLE = "JAXCLOSEUP_LPIPS"
_BACKBONE_FILES = {"vgg": "vgg16-*.pth", "alex": "alexnet-*.pth"}


class LpipsError(Exception):
    """LPIPS cannot be computed. The message is one sentence that says what to do."""


class LpipsWeights(struct.PyTreeNode):
    """The weights of one backbone and its heads.

    Attributes:
      convolutions: a kernel `[out, in, kh, kw]` and a bias `[out]` per convolution.
      heads: weights `[C]` per tapped layer.
      backbone: "vgg" or "alex".
    """

    convolutions: tuple[tuple[jax.Array, jax.Array], ...]
    heads: tuple[jax.Array, ...]
    backbone: str = struct.field(pytree_node=False)


def lpips(weights: LpipsWeights, image: jax.Array, target: jax.Array) -> jax.Array:
    """Compute LPIPS `[...]` of images `[..., H, W, 3]` in [0, 1]; 0 for equal images.

    It is differentiable in the images, which need 16 pixels a side for VGG, 31 for AlexNet.

    Raises:
      ValueError: the images are too small.
    """
    chex.assert_equal_shape([image, target])
    chex.assert_shape(image, (..., None, None, 3))
    smallest = SMALLEST[weights.backbone]
    if min(image.shape[-3:-1]) < smallest:
        raise ValueError(f"LPIPS with {weights.backbone} needs {smallest} pixels a side.")
    batch = image.shape[:-3]
    both = jnp.stack([image, target]).reshape(-1, *image.shape[-3:])
    total = jnp.zeros((both.shape[0] // 2,), both.dtype)
    for features, head in zip(_features(weights, both), weights.heads, strict=True):
        norm = safe_norm(features, keepdims=True)
        first, second = jnp.split(features / (norm + 1e-10), 2)
        difference = (first - second) ** 2
        total += jnp.mean(jnp.sum(difference * head[None, None, None], axis=-1), axis=(1, 2))
    return total.reshape(batch)


def _features(weights: LpipsWeights, images: jax.Array) -> list[jax.Array]:
    """Compute features `[N, h, w, C]` of each tapped layer of images `[N, H, W, 3]`."""
    shift, scale = (jnp.array(v, images.dtype)[None, None, None] for v in (_SHIFT, _SCALE))
    now = (2 * images - 1 - shift) / scale
    convolutions, tapped = iter(weights.convolutions), []
    for kind, *sizes in _LAYERS[weights.backbone]:
        if kind == "conv":
            _, _, stride, padding = sizes
            kernel, bias = next(convolutions)
            now = lax.conv_general_dilated(
                now,
                kernel,
                (stride, stride),
                [(padding, padding)] * 2,
                dimension_numbers=("NHWC", "OIHW", "NHWC"),
                precision=lax.Precision.HIGHEST,
            )
            now = jax.nn.relu(now + bias[None, None, None])
        elif kind == "max":
            size, stride = sizes
            window = (1, size, size, 1), (1, stride, stride, 1)
            now = lax.reduce_window(now, -jnp.inf, lax.max, *window, "VALID")
        else:
            tapped.append(now)
    return tapped


def layer_shapes(backbone: str) -> tuple[list[tuple[int, ...]], list[int]]:
    """Return kernel shapes `[out, in, kh, kw]` of the convolutions, and channels of the heads."""
    kernels: list[tuple[int, ...]] = []
    heads: list[int] = []
    channels = 3
    for kind, *sizes in _LAYERS[backbone]:
        if kind == "conv":
            kernels.append((sizes[0], channels, sizes[1], sizes[1]))
            channels = sizes[0]
        elif kind == "tap":
            heads.append(channels)
    return kernels, heads


def load_lpips(backbone: str, folder: str | os.PathLike[str] | None = None) -> LpipsWeights:
    """Read the weights of a backbone and its heads.

    The files are torchvision's `vgg16-*.pth` or `alexnet-*.pth`, and for the heads of version 0.1
    `vgg.pth` or `alex.pth` (or `lpips_vgg.pth`, `lpips_alex.pth`).

    Args:
      backbone: "vgg" or "alex".
      folder: folder of both files. By default the environment variable JAXCLOSEUP_LPIPS names it;
        without that variable, PyTorch's cache and the installed package `lpips` are searched.

    Raises:
      LpipsError: a file is missing, or does not hold these weights.
    """
    if backbone not in BACKBONES:
        raise LpipsError(f'"{backbone}" is not an LPIPS backbone: choose {" or ".join(BACKBONES)}.')
    folders = _folders(folder)
    network = _find(folders, [_BACKBONE_FILES[backbone]], f"{backbone} network")
    heads = _find(folders, [f"lpips_{backbone}.pth", f"{backbone}.pth"], f"{backbone} heads")
    kernel_shapes, channels = layer_shapes(backbone)
    try:
        of_network, of_heads = read_tensors(network), read_tensors(heads)
    except TorchFileError as error:
        raise LpipsError(str(error)) from error
    # Convolutions stand in the order of the network, as "features.<i>.weight" and ".bias".
    found = (re.fullmatch(r"features\.(\d{1,3})\.weight", name) for name in of_network)
    numbers = sorted(int(match[1]) for match in found if match)
    kernels = [of_network[f"features.{i}.weight"] for i in numbers]
    biases = [of_network.get(f"features.{i}.bias") for i in numbers]
    bias_shapes = [getattr(bias, "shape", None) for bias in biases]
    linear = [of_heads.get(f"lin{i}.model.1.weight") for i in range(len(channels))]
    if [kernel.shape for kernel in kernels] != kernel_shapes or bias_shapes != [
        shape[:1] for shape in kernel_shapes
    ]:
        raise LpipsError(f"{network} does not hold the convolutions of {backbone}: replace it.")
    if [getattr(head, "shape", None) for head in linear] != [(1, c, 1, 1) for c in channels]:
        raise LpipsError(f"{heads} does not hold the heads of LPIPS on {backbone}: replace it.")
    convolutions = tuple(
        (jnp.asarray(kernel, jnp.float32), jnp.asarray(bias, jnp.float32))
        for kernel, bias in zip(kernels, biases, strict=True)
    )
    flat = tuple(jnp.asarray(head, jnp.float32).reshape(-1) for head in linear)
    return LpipsWeights(convolutions, flat, backbone)


def _folders(folder: str | os.PathLike[str] | None) -> list[pathlib.Path]:
    if folder is None:
        folder = os.environ.get(FOLDER_VARIABLE)
    if folder is not None:
        return [pathlib.Path(folder)]
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    torch_home = os.environ.get("TORCH_HOME") or os.path.join(cache, "torch")
    folders = [pathlib.Path(torch_home) / "hub" / "checkpoints"]
    package = importlib.util.find_spec("lpips")
    if package is not None and package.origin is not None:
        folders.append(pathlib.Path(package.origin).parent / "weights" / "v0.1")
    return folders


def _find(folders: list[pathlib.Path], patterns: list[str], what: str) -> pathlib.Path:
    for folder in folders:
        for pattern in patterns:
            for path in sorted(folder.glob(pattern)):
                return path
    looked = " or ".join(map(str, folders))
    raise LpipsError(
        f"no LPIPS weights: {looked} has no {' or '.join(patterns)} ({what}): put the file there"
    )
