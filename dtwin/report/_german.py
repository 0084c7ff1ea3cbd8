"""German of a certificate, from its catalogue ``german.toml``."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files

_CATALOGUE = tomllib.loads(files("dtwin.report").joinpath("german.toml").read_text("utf-8"))
GERMAN: Mapping[str, str] = _CATALOGUE["phrases"]
"""Words and phrases."""
CLAUSES: Mapping[str, str] = _CATALOGUE["clauses"]
"""Clauses of findings and notes."""
_WORDS: Mapping[str, str] = _CATALOGUE["words"]
_PIECES = [(clause.split("{}"), german) for clause, german in CLAUSES.items()]
# A longer text is no finding of dtwin's. Names that stand for ``{}`` have no more blanks than these.
_LONGEST, _MOST_SPACES = 1500, 2
_WORD = re.compile("[A-Za-z]{3}")


def german_of(text: str, tell: Callable[[object], str]) -> str | None:
    """Return a finding or note in German; None when a clause of it is not known. ``tell``: writes names and numbers."""

    # Names of files and machines stand in a finding: each part is looked at once, however they are written.
    @cache
    def clause(part: str) -> str | None:
        for pieces, german in _PIECES:
            if (between := _between(pieces, part)) is not None:
                words = [_worded(word) or clause(word) or _name(word, tell) for word in between]
                if None not in words:
                    return german.format(*words)
        named, colon, rest = part.partition(": ")
        said = clause(rest) if colon and _are_names(named) else None
        return None if said is None else f"{tell(named)}: {said}"

    if len(text) > _LONGEST:
        return None
    parts = re.split(r"(; |\. (?=[A-Z]))", text.removesuffix("."))
    told = [clause(part) if n % 2 == 0 else part for n, part in enumerate(parts)]
    return None if None in told else "".join(map(str, told)) + "." * text.endswith(".")


def _worded(text: str) -> str | None:
    words = [_WORDS.get(word) for word in re.split("(?<!,) or ", text)]
    return None if None in words else " oder ".join(map(str, words))


def _between(pieces: Sequence[str], text: str) -> list[str] | None:
    """Return what stands between the pieces of a clause, each piece at its first place; None for another text."""
    first, *middle = pieces
    if not middle:
        return [] if text == first else None
    *middle, last = middle
    at, end, found = len(first), len(text) - len(last), []
    if at > end or not text.startswith(first) or not text.endswith(last):
        return None
    for piece in middle:
        after = text.find(piece, at, end)
        if after < 0:
            return None
        found.append(text[at:after])
        at = after + len(piece)
    return [*found, text[at:end]]


def _name(text: str, tell: Callable[[object], str]) -> str | None:
    return tell(text) if _are_names(text) or not _WORD.search(text) else None


def _are_names(text: str) -> bool:
    return all(name.count(" ") <= _MOST_SPACES for name in text.split(", "))
