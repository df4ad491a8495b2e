"""Describe an installation: versions, devices, the native library, and what each extra adds."""

import importlib.metadata
import os
import platform
import shutil

import jax

from jaxcloseup.io.memory import installed_memory
from jaxcloseup.native import library
from jaxcloseup.version import __version__


# By extra: the package that it installs, and what it is for.
EXTRAS = {
    "colmap": ("pycolmap", "poses from photographs (closeup, process); COLMAP models"),
    "viewer": ("viser", "the viewer (view)"),
    "mesh": ("scikit-image", "meshes (mesh, closeup --mesh)"),
    "video": ("imageio-ffmpeg", "MP4 videos; without it they are WebM"),
    "tensorboard": ("tensorboardX", "event files (--tensorboard)"),
}
_COMPILERS = "g++", "clang++"


def describe() -> str:
    """Return lines about this installation; each that lacks something says what to do."""
    devices = ", ".join(sorted({device.device_kind for device in jax.devices()}))
    memory = installed_memory() / 2**30
    reason = library.missing()
    native = f"loaded from {library.path()}" if reason is None else reason
    found = [name for name in _COMPILERS if shutil.which(name)]
    if reason is not None:
        native += "; surfels on CPUs take several times as long: "
        native += "install jaxcloseup again" if found else "install g++, then jaxcloseup again"
    rows = [
        ("jaxcloseup", __version__),
        ("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        *((name, importlib.metadata.version(name)) for name in ("jax", "jaxlib", "numpy")),
        ("devices", f"{devices} ({jax.default_backend()})"),
        ("computer", f"{os.cpu_count()} cores, {memory:.0f} GiB"),
        ("compiler", ", ".join(found) or "none"),
        ("native library", native),
        *((f'extra "{name}"', _describe_extra(name)) for name in EXTRAS),
    ]
    if platform.system() == "Linux" and shutil.which("nvidia-smi") and devices == "cpu":
        rows.append(("GPU", 'there is one that JAX does not use: install the extra "cuda"'))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:{width}}  {what}" for name, what in rows)


def _describe_extra(extra: str) -> str:
    package, purpose = EXTRAS[extra]
    try:
        return f"{package} {importlib.metadata.version(package)}: {purpose}"
    except importlib.metadata.PackageNotFoundError:
        return f"not installed; it would add: {purpose}"
