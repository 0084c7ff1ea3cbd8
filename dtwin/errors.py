"""Errors that a user can act on: what, where, got, allowed, what to try."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import cached_property

EXIT_DONE = 0
EXIT_USER = 1
_EXIT_COMMAND_LINE = 2
EXIT_GATE = 3
EXIT_DEVICE = 4
EXIT_INTERRUPTED = 130
NEWER = "where a newer dtwin wrote it: install that; else take out what is not known"
"""What to try with a file that states what this version does not know."""
# Of more names than these a terminal shows those that are most like what was given; JSON has all.
_MOST_NAMES, _NEAREST = 60, 12
# Of a longer place or value, such as a name of thousands of letters in a file, a terminal shows both ends.
_LONGEST = 400
# What would steer a terminal, turn the order of letters round, or is half a letter: out of a file that somebody sent.
_STEERING = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return a text for a terminal or a page, in which the sign of an unknown character stands for what would steer it, or is none."""
    return _STEERING.sub("\ufffd", text)


def in_a_line(error: Exception) -> str:
    """Return what a library says, in a line: that of the database, which another may stand above and statements below."""
    lines = str(error).split("\n")
    return next((line for line in lines if "(sqlite3." in line), lines[0])[:200]


def _slipped(given: str, name: str) -> bool:
    """Return whether a name of three letters was given with one wrong, or with two exchanged; other digits are another name."""
    wrong = [i for i, (a, b) in enumerate(zip(given, name, strict=False)) if a != b]
    if len(given) != len(name) or len(name) < 3 or not 1 <= len(wrong) <= 2:
        return False
    if len(wrong) == 1:
        return not (given[wrong[0]].isdigit() and name[wrong[0]].isdigit())
    return wrong[1] == wrong[0] + 1 and sorted(given) == sorted(name)


class DtwinError(Exception):
    """A problem that the user can understand and mend.

    Args:
        code: Stable dotted identifier, for example ``"b5r.truncated"``.
        where: File, line, column, run or setting that is wrong.
        hint: What to try next; may be a command.
    """

    exit_code = EXIT_USER

    def __init__(
        self,
        message: str,
        *,
        code: str = "error",
        where: str | None = None,
        got: str | None = None,
        allowed: str | None = None,
        hint: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code
        self.where = where
        self.got = got
        self.allowed = allowed
        self.hint = hint

    @property
    def meant(self) -> str | None:
        """The allowed name that is most like what was given; None when none is."""
        got, names = self.got or "", self._names()
        close = get_close_matches(got, names, n=1, cutoff=0.7) or [name for name in names if _slipped(got, name)][:1]
        # A word of what was given is no other name for it, as the unit behind a number.
        return close[0] if close and close[0] not in re.split(", | ", got) else None

    def _names(self) -> list[str]:
        """Return the allowed names; a sentence about what is allowed is no list of names."""
        names = [] if self.allowed is None else self.allowed.replace(" ...", "").split(", ")
        return [name for name in names if " " not in name and not name.isdecimal()]

    def as_dict(self) -> dict[str, str]:
        """Return the set fields, for ``--json``."""
        fields = {
            "code": self.code,
            "message": self.message,
            "where": self.where,
            "got": self.got,
            "meant": self.meant,
            "allowed": self.allowed,
            "hint": self.hint,
        }
        return {name: value for name, value in fields.items() if value is not None}

    def render(self) -> str:
        """Return the message as indented lines for a terminal."""
        lines = [f"error[{self.code}]: {self.message}"]
        labels = {"where": "at", "got": "got", "meant": "did you mean", "allowed": "allowed", "hint": "try"}
        fields = self.as_dict()
        names = self._names()
        if len(names) > _MOST_NAMES:
            nearest = get_close_matches(self.got or "", names, n=_NEAREST, cutoff=0.0)
            fields["allowed"] = f"{', '.join(nearest)} and {len(names) - len(nearest)} more"
        for name in ("where", "got"):
            if len(fields.get(name, "")) > _LONGEST:
                fields[name] = f"{fields[name][: _LONGEST // 2]} … {fields[name][-_LONGEST // 2 :]}"
        lines += [f"  {label}: {fields[name]}" for name, label in labels.items() if name in fields]
        return printable("\n".join(lines))

    @cached_property
    def __notes__(self) -> list[str]:  # type: ignore[override]
        """What Python shows below a traceback: a notebook shows no more of an error than its message."""
        return self.render().split("\n")[1:]


class InputError(DtwinError):
    """A file, plan or option that cannot be used as given."""


class CommandLineError(InputError):
    """Arguments or options that the command does not have, or lacks."""

    exit_code = _EXIT_COMMAND_LINE


class StoreError(DtwinError):
    """The lake or another part of ``DTWIN_HOME`` cannot be read or written."""


class MissingPart(DtwinError):
    """An optional package, driver or program is not installed."""


class GateRefusal(DtwinError):
    """A check of a model or of its evidence said no."""

    exit_code = EXIT_GATE


class DeviceError(DtwinError):
    """A device is absent, silent or stopped for safety."""

    exit_code = EXIT_DEVICE


class Interrupted(DtwinError):
    """Work was stopped and can be resumed; the hint holds the command."""

    exit_code = EXIT_INTERRUPTED
