"""Write the tables of flags, methods and settings into docs/programs.md.

python -m experiments.studies.program_tables [--compare]
"""

import importlib
import pathlib
import re
import sys
import types

from absl import flags

from jaxcloseup.app.cli import main as command
from jaxcloseup.app.cli.start import start
from jaxcloseup.app.cli.topics import describe_flag, flags_by_topic
from jaxcloseup.app.methods.registry import METHODS
from jaxcloseup.app.methods.settings import settings_of
from jaxcloseup.app.report.record_table import Table, markdown


DOCUMENT = pathlib.Path(__file__).parents[2] / "docs" / "programs.md"
_TOLD_BELOW = ("method", "preset")
_COMPARE = flags.DEFINE_bool(
    "compare", False, "fail if the document's tables are not those of today"
)


def tables() -> dict[str, str]:
    """Return each table in Markdown by the name that stands in its comment."""
    rows = [(f"`{name}`", what) for name, what in command.PROGRAMS.items()]
    found = {"programs": _table("program", rows)}
    described: set[str] = set()
    for name in command.PROGRAMS:
        module = importlib.import_module(f"jaxcloseup.app.cli.{name}")
        found[f"flags {name}"] = _flag_table(module, described)
    rows = [
        (f"`{name}`", f"{method.help}; presets {', '.join(f'`{one}`' for one in method.presets)}")
        for name, method in METHODS.items()
    ]
    found["methods"] = _table("method", rows)
    settings = settings_of(METHODS["surfels"].presets["quick"]).values()
    rows = [
        (f"`{setting.name}`", setting.limits.help)
        for setting in settings
        if setting.path[0] in ("labels", "targets")
    ]
    found["settings labels"] = _table("setting", rows)
    return found


def _flag_table(program: types.ModuleType, described: set[str]) -> str:
    """Return a program's flags; those that an earlier program has are only named."""
    rows, again = [], []
    for group in flags_by_topic(flags.FLAGS.get_key_flags_for_module(program.__name__)).values():
        for flag in group:
            if flag.name in described:
                again.append(f"`--{flag.name}`")
                continue
            described.add(flag.name)
            text = describe_flag(flag).replace("|", "\\|")
            text = text.split(": ")[0] + ", see below" if flag.name in _TOLD_BELOW else text
            shown = f"`--[no]{flag.name}`" if flag.boolean else f"`--{flag.name}`"
            rows.append((shown, " ".join(text.split())))
    table = _table("flag", rows)
    return f"{table}\nand, as above, {', '.join(again)}\n" if again else table


def _table(title: str, rows: list[tuple[str, str]]) -> str:
    return markdown(Table(title, [title, ""], rows))


def main(_: list[str]) -> None:
    """Replace what stands between the comments of the document."""
    text = before = DOCUMENT.read_text(encoding="utf-8")
    for name, table in tables().items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        text = pattern.sub(lambda match, table=table: match[1] + table + match[2], text)
    if _COMPARE.value:
        sys.exit(0 if text == before else f"{DOCUMENT} is not of today: run this without --compare")
    DOCUMENT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    start(sys.modules[__name__])
