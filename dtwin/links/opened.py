"""What every device is: something that is opened, and released whatever happens."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Any, Self


class Closed(ABC):
    """The context manager of what is open once it is made."""

    @abstractmethod
    def close(self) -> None:
        """Release the device."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class OpenAndClose(Closed):
    """The context manager of every instrument, line and output."""

    @abstractmethod
    def open(self) -> Any:
        """Connect and set up."""

    def __enter__(self) -> Self:
        self.open()
        return self
