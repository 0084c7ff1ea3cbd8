"""Kinds whose runs are compared on a grid along a path: one fit and one report serve the twins of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dtwin.kinds.kind import Kind

if TYPE_CHECKING:
    from dtwin.config import Home
    from dtwin.kinds.twin_report import TwinReport
    from dtwin.physics.effect import Effect
    from dtwin.twins.verbs import Twins


class PathKind(Kind):
    """A kind that has ``rows``, and with them twins of a path."""

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> Twins:
        """Return the twins of a home that are of any path."""
        from dtwin.twins.verbs import Twins

        return Twins(home, library)

    @property
    def twin_report(self) -> TwinReport:
        """How twins of a path are told."""
        from dtwin.report import twins

        return twins
