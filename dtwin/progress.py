"""What long work tells those who wait for it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[int, int, str], None]
"""Called with how many steps are done, of how many, and what the last one was."""
StageProgress = Callable[[str, int, int, str], None]
"""The same of work in several stages: called with the stage's name first."""
Tell = Callable[[str], None]
"""Called with what is done now, of work whose steps nobody can count before."""


def silent(*_: object) -> None:
    """Tell nobody."""


_listener: ContextVar[Tell] = ContextVar("listener", default=silent)


def tell(stage: str) -> None:
    """Tell the listener of this thread, if there is one, what is done now."""
    _listener.get()(stage)


@contextmanager
def telling(listener: Tell) -> Iterator[None]:
    """Have a listener hear what work in this thread tells meanwhile."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)
