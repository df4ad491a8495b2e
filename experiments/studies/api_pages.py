"""Write API pages of the library from its docstrings, by pdoc.

python -m experiments.studies.api_pages --output_dir=outputs/api
"""

import importlib
import pathlib
import pkgutil

from absl import app, flags

import jaxcloseup


_OUTPUT_DIR = flags.DEFINE_string("output_dir", "outputs/api", "folder for the pages")
_INTERNAL = ("jaxcloseup.app", "jaxcloseup.__main__")


def main(_: list[str]) -> None:
    """Load every module and every public name, which packages load on first use, and write pages.

    Raises:
      SystemExit: pdoc is not installed.
    """
    try:
        import pdoc
    except ImportError:
        raise SystemExit("API pages need pdoc: install the extra test") from None
    modules = ["jaxcloseup"]
    modules += [
        found.name
        for found in pkgutil.walk_packages(jaxcloseup.__path__, "jaxcloseup.")
        if not found.name.startswith(_INTERNAL)
    ]
    for name in modules:
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ()):
            getattr(module, public)  # pdoc reads what a module holds: this loads it
    pdoc.render.configure(docformat="google", math=False)
    folder = pathlib.Path(_OUTPUT_DIR.value)
    folder.mkdir(parents=True, exist_ok=True)
    pdoc.pdoc("jaxcloseup", *(f"!{name}" for name in _INTERNAL), output_directory=folder)
    print(f"{len(modules)} pages in {folder}: open {folder / 'index.html'}")


if __name__ == "__main__":
    app.run(main)
