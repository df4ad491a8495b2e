"""Sentences for the user, about files that may say anything."""

import shutil
import textwrap
import unicodedata


_LONGEST = 150  # characters of what another library says


def printable(text: str) -> str:
    """Escape what a terminal would obey or that no file holds: names in files may say anything."""
    return "".join(
        character.encode("unicode_escape").decode() if is_control(character) else character
        for character in text
    )


def is_control(character: str) -> bool:
    """Return whether a character controls, formats or breaks lines, or is half of another."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")


def reason(error: Exception) -> str:
    """Return the beginning of another library's error message, on one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def describe_option(shown: str, about: str) -> str:
    """Return lines of help, as wide as the terminal: an option with its value, and its text."""
    width = min(max(shutil.get_terminal_size().columns, 60), 100)
    left = " " * 26
    wrapped = textwrap.fill(
        about, width, initial_indent=left, subsequent_indent=left, break_on_hyphens=False
    )
    first = f"  {shown}"
    return first + wrapped[len(first) :] if len(first) < len(left) - 1 else f"{first}\n{wrapped}"
