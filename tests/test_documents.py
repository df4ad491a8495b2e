"""The documents are short, lead somewhere, and describe the programs of today."""

import pathlib
import re
import subprocess
import sys

import pytest
from wrong_captures import CASES


ROOT = pathlib.Path(__file__).parents[1]
DOCUMENTS = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]
LONGEST_README, LONGEST_DOCS = 120, 1300  # lines


def lines(path):
    return len(path.read_text(encoding="utf-8").splitlines())


def anchors(path):
    """The anchors that GitHub gives to a document's headings."""
    titles = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_documents_stay_short():
    assert lines(ROOT / "README.md") < LONGEST_README
    assert sum(lines(path) for path in (ROOT / "docs").glob("*.md")) < LONGEST_DOCS


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if target.startswith("http"):
            continue
        file, _, anchor = target.partition("#")
        linked = (path.parent / file).resolve() if file else path
        assert linked.exists(), f"{path.name} links to {target}"
        if anchor:
            assert anchor in anchors(linked), f"{path.name} links to {target}"


def test_tables_of_programs_are_those_of_today():
    check = [sys.executable, "-m", "experiments.studies.program_tables", "--compare"]
    done = subprocess.run(check, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_troubles_that_photographs_md_quotes_are_what_programs_say():
    """Those of loading are cases of wrong captures, whose sentences are asserted."""
    said = [words for cases in CASES.values() for _, words, *_ in cases]
    for module in ("checks/judge.py", "app/process/capture_summary.py"):
        text = (ROOT / "jaxcloseup" / module).read_text(encoding="utf-8")
        said.append(re.sub(r'"\n\s+f?"', "", text))
    _, _, table = (
        (ROOT / "docs/photographs.md").read_text(encoding="utf-8").partition("bad capture")
    )
    quoted = re.findall(r'^\| "(?:\.\.\. )?(.*?)"', table, re.MULTILINE)
    assert len(quoted) == 4
    for one in quoted:
        assert any(one in sentence for sentence in said), one
