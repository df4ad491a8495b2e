"""Examples and the code block of README.md run, and print what they show."""

import pathlib
import re
import runpy
import textwrap

import jax
import pytest


ROOT = pathlib.Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_prints_what_it_shows(path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(path.parent)
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    shown = re.search(r"\nOutput:\n\n(.*?)\n\"\"\"", text, re.DOTALL)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip() == textwrap.dedent(shown[1]).strip()


def test_the_example_of_the_readme_prints_what_it_says(capsys):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(code, "README.md", "exec"), {})
    for line in capsys.readouterr().out.splitlines():
        assert line in text, line
