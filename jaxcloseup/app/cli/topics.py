"""Topics of flags: `--help` groups flags by the topic within which they are defined."""

import contextlib
import itertools
import re
from collections.abc import Iterable, Iterator

from absl import flags


FLAGS = flags.FLAGS
_TOPICS: dict[str, list[str]] = {}  # names of flags


@contextlib.contextmanager
def topic(title: str) -> Iterator[list[str]]:
    """Put the flags that are defined meanwhile under a title; yield the list of their names."""
    before = set(FLAGS)
    named: list[str] = []
    yield named
    named += [name for name in FLAGS if name not in before]
    _TOPICS.setdefault(title, []).extend(named)


def share(*groups: list[str]) -> None:
    """Show flags of other modules in the `--help` of the module that calls this."""
    for name in itertools.chain(*groups):
        flags.declare_key_flag(name)


def describe_flag(flag: flags.Flag) -> str:
    """Return what a flag does, without what absl adds to its help."""
    return re.sub(r"^<.*?>: |;\s+repeat this option .*", "", flag.help)


def flags_by_topic(shown: Iterable[flags.Flag]) -> dict[str, list[flags.Flag]]:
    """Return flags by topic, in the order in which topics were begun; others come first."""
    found = {flag.name: flag for flag in shown}
    known = {name for names in _TOPICS.values() for name in names}
    topics = {"Its own flags": [found[name] for name in found if name not in known]}
    for title, names in _TOPICS.items():
        topics[title] = [found[name] for name in names if name in found]
    return {title: group for title, group in topics.items() if group}


flags.disclaim_key_flags()  # `share` declares flags for its caller
