"""Sentences for the user, about files that may say anything."""

import unicodedata


_LONGEST = 150  # characters of what another library says


def printable(text: str) -> str:
    """Escape what a terminal would obey or that no file holds: names in files may say anything."""
    return "".join(
        character.encode("unicode_escape").decode() if is_control(character) else character
        for character in text
    )


def is_control(character: str) -> bool:
    """Whether a character controls, formats or breaks lines, or is half of another."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")


def reason(error: Exception) -> str:
    """The beginning of what another library says of an error, on one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
