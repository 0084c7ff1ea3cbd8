"""Where an operator reads what to do next, and answers: in the terminal, or in the browser.

The question lies in a file of the campaign folder, the answer in another, so that whoever sees the
folder can answer, also after a restart of one or the other.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.processes import process

_QUESTION, _ANSWER = "desk.json", "desk.answer.json"
DONE, REPEAT, KEEP = "done", "repeat", "keep"
_WORD = re.compile("[a-z0-9]{1,20}")


@dataclass(frozen=True)
class Question:
    """What an operator is asked to do or to say.

    ``answers``: what may be answered, the usual one first.
    ``asked_by``: process that asks, as :func:`dtwin.processes.process` states it.
    """

    run: str
    text: str
    answers: tuple[str, ...]
    programs: tuple[str, ...] = ()
    step: int = 0
    steps: int = 0
    id: str = field(default_factory=lambda: secrets.token_hex(6))
    asked_by: str = field(default_factory=process)


class Desk:
    """Asks one question at a time.

    ``typed``: returns what was typed since the last time, None when nothing was; an empty line means the usual answer.
    """

    def __init__(self, folder: Path, show: Callable[[str], None], typed: Callable[[], str | None]) -> None:
        self._folder, self.show, self._typed = folder, show, typed
        self._question: Question | None = None

    def ask(self, question: Question) -> None:
        """Put a question, in place of the one before."""
        self._question = question
        text = json.dumps(asdict(question), indent=1)
        write_text(self._folder / _QUESTION, text, "what the operator is asked")
        self.show(question.text)

    def answer(self) -> str | None:
        """Return the answer to the question, None while there is none."""
        question = self._question
        if question is None:
            return None
        given = _answer_file(self._folder, question)
        if given is None and (typed := self._typed()) is not None:
            given = _meant(typed, question.answers)
            if given is None:
                self.show(f"not understood; one of: {', '.join(question.answers)}")
        return given

    def again(self) -> None:
        """Forget an answer that led nowhere: the question stays."""
        (self._folder / _ANSWER).unlink(missing_ok=True)

    def clear(self) -> None:
        """Take the question away."""
        self._question = None
        for name in (_QUESTION, _ANSWER):
            (self._folder / name).unlink(missing_ok=True)


def _open_question(folder: Path) -> Mapping[str, Any] | None:
    """Return what is asked in a campaign folder, None when nothing is."""
    try:
        stated: dict[str, Any] = json.loads((folder / _QUESTION).read_text(encoding="utf-8"))
        question = asdict(Question(**stated))
        # Others may write into the folder of a campaign, and a page makes the address of a button of these words.
        sound = all(_WORD.fullmatch(word) for word in (question["id"], *question["answers"]))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return question if sound else None


def enter_desk(home: Home, folder: Path) -> None:
    """Remember where a campaign is measured, so that the browser finds its desk."""
    place = str(folder.resolve())
    name = hashlib.sha256(place.encode()).hexdigest()[:16]
    write_text(home.root / "desks" / name, place, "where the campaign is measured")


def desks(home: Home) -> dict[str, tuple[Path, Mapping[str, Any]]]:
    """Return folder and question of every campaign that is being measured, by the desk's name."""
    by_name = {}
    for entry in sorted((home.root / "desks").glob("*")):
        try:
            folder = Path(entry.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        question = _open_question(folder)
        if question is not None and _alive(question["asked_by"]):
            by_name[entry.name] = folder, question
    return by_name


def _alive(stated: object) -> bool:
    number = str(stated).split(" ")[1:2]
    return bool(number) and number[0].isdigit() and process(int(number[0])) == stated


def give_answer(folder: Path, question_id: str, answer: str) -> None:
    """Answer a question. Raises ``InputError`` when this is not asked now, or not answered so."""
    asked = _open_question(folder)
    if asked is None or asked["id"] != question_id or answer not in asked["answers"]:
        raise InputError(
            "this is not asked now",
            code="campaign.answer",
            where=str(folder),
            got=answer[:40],
            allowed=", ".join(asked["answers"]) if asked else "nothing is asked",
            hint="look again: the campaign has gone on",
        )
    text = json.dumps({"question": question_id, "answer": answer})
    write_text(folder / _ANSWER, text, "the operator's answer")


def _answer_file(folder: Path, question: Question) -> str | None:
    try:
        document = json.loads((folder / _ANSWER).read_text(encoding="utf-8"))
        answer = document["answer"] if document["question"] == question.id else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return answer if answer in question.answers else None


def _meant(typed: str, answers: Sequence[str]) -> str | None:
    word = typed.strip().lower()
    if not word:
        return answers[0]
    return next((answer for answer in answers if answer.startswith(word)), None)
