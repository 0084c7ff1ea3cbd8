"""What long work tells those who wait for it."""

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""Called with how many steps are done, of how many, and what the last one was."""
StageProgress = Callable[[str, int, int, str], None]
"""The same of work in several stages: called with the stage's name first."""


def silent(*_: object) -> None:
    """Tell nobody."""
