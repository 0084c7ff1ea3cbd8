"""Languages of documents: phrases, findings and sentences by the catalogue; what is not there stays English."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, cached_property
from heapq import merge
from importlib.resources import files

from dtwin.errors import InputError

_CERTIFICATE, _TWINS = (
    tomllib.loads(files("dtwin.report").joinpath(name).read_text("utf-8"))
    for name in ("german.toml", "german_twins.toml")
)
_GERMAN: Mapping[str, str] = _CERTIFICATE["phrases"]
"""Words and phrases."""
_CLAUSES: Mapping[str, str] = _CERTIFICATE["clauses"] | _TWINS["clauses"]
"""Clauses of findings and notes."""
_WORDS: Mapping[str, str] = _CERTIFICATE["words"] | _TWINS["words"]
_TITLES: Mapping[str, str] = _TWINS["titles"]
"""What stands alone."""
_EXACT = {clause: german for clause, german in _CLAUSES.items() if "{}" not in clause}
_Clause = tuple[int, list[str], str]


def _by_ends(clauses: Mapping[str, str]) -> Mapping[tuple[str, str], list[_Clause]]:
    """Return clauses with names in them by their first and their last two letters, none where there are fewer.

    What is said in more words comes first: ``{} ({} %)`` would be the end of a longer clause.
    """
    parted = [(clause.split("{}"), german) for clause, german in clauses.items() if "{}" in clause]
    by_ends = defaultdict[tuple[str, str], list[_Clause]](list)
    for n, (pieces, german) in enumerate(sorted(parted, key=lambda pair: -sum(map(len, pair[0])))):
        first, last = pieces[0], pieces[-1]
        by_ends[first[:2] if first[1:] else "", last[-2:] if last[1:] else ""].append((n, pieces, german))
    return by_ends


_PIECES = _by_ends(_CLAUSES)
# A longer text is no finding of dtwin's. Names that stand for ``{}`` have no more blanks than these.
_LONGEST, _MOST_SPACES = 1500, 2
_AMENDED = "metadata version "
_WORD = re.compile("[A-Za-z]{3}")
_FUNCTION = re.compile(r"\b(?:cos|sin|exp)\b")
_WORDS_OF = re.compile("[A-Za-z]{3,}")
_LIST = re.compile("[,;] | or | [+] ")
# An effect by the name that commands take, with its axis: what people name has no blank.
_LABEL = re.compile(r"[a-z]\w* (?:[A-Z0-9]{1,4}|axis_\d)")
_MORE = re.compile(r"and (\d+) more")
_AXIS = re.compile(r"[A-Z0-9]{1,4}|axis_\d")
_NUMBER = r"[-+]?\d[\d.]*(?:e[-+]?\d+)?"
_SIZE = re.compile(
    rf"(?:(?P<name>(?!about )[A-Za-z][\w ]*?) )?(?P<size>(?:about )?{_NUMBER}(?: ± {_NUMBER})?(?: [^\s;,]+(?: [mh]\)\S*)?)?)"
)


def _german_of(text: str, tell: Callable[[object], str]) -> str | None:
    """Return a finding or note in German; None when a clause of it is not known. ``tell``: writes names and numbers."""

    # Names of files and machines stand in a finding: each part is looked at once, however they are written.
    @cache
    def clause(part: str) -> str | None:
        if part in _EXACT:
            return _EXACT[part]
        # A list before a clause of which one word would be a part of the list.
        every = [clause(one) for one in part.split(", ")] if ", " in part else [None]
        if None not in every:
            return ", ".join(map(str, every))
        named, colon, rest = part.partition(": ")
        who = _titled(named) if colon else None
        if who is not None and (said := clause(rest)) is not None:
            return f"{who}: {said}"
        ends = {(first, last) for first in (part[:2], "") for last in (part[-2:], "")}
        for _, pieces, german in merge(*(_PIECES.get(key, ()) for key in ends)):
            if (between := _between(pieces, part)) is not None:
                words = [
                    (_TITLES.get(word) if before.endswith("(") else None)
                    or _worded(word)
                    or clause(word)
                    or _name(word, tell)
                    for before, word in zip(pieces, between, strict=False)
                ]
                if None not in words:
                    return german.format(*words)
        if colon and (said := clause(rest)) is not None:
            # A number is the size of what is known by name.
            who = clause(named) or (None if _sized(rest, tell) else _name(named, tell))
            return None if who is None else f"{who}: {said}"
        return _sized(part, tell) or _labels(part)

    told_by, because, reason = text.partition(", because ")
    if because and text.startswith(_AMENDED):
        # The reason is in the words of whoever gave it.
        said = _german_of(told_by, tell)
        return None if said is None else f"{said}, Grund: {reason}"
    if len(text) > _LONGEST:
        return None
    parts = re.split(r"(; |\. (?=[A-Z]))", text.removesuffix("."))
    told = [clause(part) if n % 2 == 0 else part for n, part in enumerate(parts)]
    if None in told:
        # Of names of effects some are parted by semicolons.
        return clause(text)
    return "".join(map(str, told)) + "." * text.endswith(".")


def _worded(text: str) -> str | None:
    words = [_WORDS.get(word) for word in re.split("(?<!,) or ", text)]
    return None if None in words else " oder ".join(map(str, words))


def _titled(text: str) -> str | None:
    """Return names of effects, each with its axis or without; None where one is not known."""
    if text in _TITLES:
        return _TITLES[text]
    if more := _MORE.fullmatch(text):
        return f"und {more[1]} weitere"
    for between, german in ((" or ", " oder "), ("; ", "; "), (" + ", " + ")):
        if between in text:
            every = [_titled(one) for one in text.split(between)]
            return None if None in every else german.join(map(str, every))
    told: list[str] = []
    for part in text.split(", "):
        title, _, axis = part.rpartition(" ")
        if part in _TITLES:
            told.append(_TITLES[part])
        elif title in _TITLES and _AXIS.fullmatch(axis):
            told.append(f"{_TITLES[title]} {axis}")
        elif told and _AXIS.fullmatch(part):
            told.append(part)
        else:
            return None
    return ", ".join(told)


def _labels(text: str) -> str | None:
    """Return effects as commands name them, each with its axis, or several; None for another text."""
    return _titled(text) if _LIST.search(text) or _LABEL.fullmatch(text) else None


def _sized(text: str, tell: Callable[[object], str]) -> str | None:
    """Return a number with its uncertainty and unit, with its name or without."""
    match = _SIZE.fullmatch(text)
    if match is None or (match["name"] or "scale") not in _TITLES:
        return None
    size = tell(match["size"]).replace("about ", "etwa ")
    return f"{_TITLES[match['name']]} {size}" if match["name"] else size


def _between(pieces: Sequence[str], text: str) -> list[str] | None:
    """Return what stands between the pieces of a clause, each piece at its first place; None for another text."""
    first, *middle = pieces
    if not middle:
        return [] if text == first else None
    *middle, last = middle
    at, end, parts = len(first), len(text) - len(last), []
    if at > end or not text.startswith(first) or not text.endswith(last):
        return None
    for piece in middle:
        after = text.find(piece, at, end)
        if after < 0:
            return None
        parts.append(text[at:after])
        at = after + len(piece)
    return [*parts, text[at:end]]


def _name(text: str, tell: Callable[[object], str]) -> str | None:
    if (text[:1].isupper() and (title := _titled(text))) or (title := _labels(text)):
        return title
    if text.startswith("dtwin "):
        # A command is the same in every language.
        return text
    for between, german in ((" and ", " und "), (" or ", " oder ")):
        if between in text:
            every = [_WORDS.get(one) or _name(one, tell) for one in text.split(between)]
            return None if None in every else german.join(map(str, every))
    told = tell(text)
    # Formulas, names and numbers, or phrases of which every word is known.
    known = (
        not _WORD.search(_FUNCTION.sub("", text))
        or _are_names(text)
        or not {*_WORDS_OF.findall(text)} & {*_WORDS_OF.findall(told)}
    )
    return told if known else None


def _are_names(text: str) -> bool:
    return all(name.count(" ") <= _MOST_SPACES for name in text.split(", "))


_DECIMAL_POINT = {"de": ","}
_LANGUAGES: Mapping[str, Mapping[str, str]] = {"en": {}, "de": _GERMAN}
"""Words and phrases of a document by language; what is not there is English."""


class Language:
    """A language of documents.

    ``code``: ``en`` or ``de``.
    ``names``: what people named, which stays as they named it.
    Raises ``InputError`` for another code.
    """

    def __init__(self, code: str = "en", names: Iterable[str] = ()) -> None:
        if code not in _LANGUAGES:
            raise InputError("no such language", code="document.language", got=code[:20], allowed=", ".join(_LANGUAGES))
        self.code = code
        self.point = _DECIMAL_POINT.get(code, ".")
        self._words = _LANGUAGES[code]
        self._phrases = {**self._words, **{name: name for name in names}}

    @cached_property
    def _phrase(self) -> re.Pattern[str]:
        longest_first = "|".join(map(re.escape, sorted(self._phrases, key=len, reverse=True)))
        return re.compile(rf"(?<![\w-])(?:{longest_first})(?![\w-])|(?<=\d)\.(?=\d)")

    def say(self, word: str) -> str:
        """Return a word or phrase that stands alone."""
        return self._words.get(word, word)

    def tell(self, text: object) -> str:
        """Translate the phrases that are known in a longer text, and write its numbers as the language does."""
        if not self._words:
            return str(text)
        return self._phrase.sub(lambda found: self._phrases.get(found[0], self.point), str(text))

    def spoken(self, text: str) -> tuple[str, str]:
        """Return a sentence, and the language that it is in."""
        said = _german_of(text, self.tell) if self._words else None
        return (text, "en") if said is None else (said, self.code)

    def read(self, text: str) -> tuple[str, str]:
        """Return a sentence or a text of phrases alone, as a sheet says what it rests on, and the language that it is in."""
        said, code = self.spoken(text)
        if code != self.code and not _WORD.search(self._phrase.sub("", text).replace("ISO", "")):
            return self.tell(text), self.code
        return said, code

    def cell(self, text: str) -> str:
        """Return what stands in a table: a phrase, a name of an effect, a size or a sentence; else as it is."""
        if not self._words:
            return text
        return self._words.get(text) or _titled(text) or self.read(text)[0]

    def drawn(self, text: str) -> str:
        """Return what stands in a picture about a twin."""
        if not self._words:
            return text
        head, comma, campaign = text.rpartition(", ")
        title = _titled(text) or (f"{one}, {campaign}" if comma and (one := _titled(head)) else None)
        return title or self.read(text)[0]
