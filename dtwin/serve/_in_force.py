"""What the machine's end may hold: the corrections that were sent, and the number that it reports.

A machine's end holds what it reported, or anything that was sent after that. While the next
correction is within one step of each of these, none of its own changes is longer than a step,
whatever was held up on the way.
"""

from __future__ import annotations

import math

import numpy as np

from dtwin.errors import DeviceError
from dtwin.features.compiled import compiled
from dtwin.links.layout import SEQUENCE_LIMIT
from dtwin.schema import Floats

_REMEMBERED = 256


@compiled
def _farthest_kernel(sent_um: Floats, last: int, behind: int, out_um: Floats) -> float:
    """Return the longest distance in um from ``out_um`` to the newest ``behind + 1`` vectors.

    ``sent_um`` (n, 3): ring of vectors.
    ``last``: count of the newest one; its place is the remainder by n.
    ``behind``: how many are newer than the one in force.
    ``out_um`` (3,): from where.
    """
    longest = 0.0
    for back in range(behind + 1):
        row = sent_um[(last - back) % sent_um.shape[0]]
        square = 0.0
        for i in range(3):
            square += (out_um[i] - row[i]) ** 2
        longest = max(longest, square)
    return float(np.sqrt(longest))


class InForce:
    """Numbers what is sent, and knows what of it may be in force.

    ``first_sequence``: sequence number to start from.
    ``engaged``: whether the machine's end has reported a correction of ours as in force; while it has not, or not since
    it let go, only zeros may be sent.
    ``sequence``: number of the newest correction.
    """

    def __init__(self, first_sequence: int) -> None:
        self.engaged = False
        self.sequence = first_sequence - 1
        self._first = first_sequence
        self._sent_um, self._sent_s = np.zeros((_REMEMBERED, 3)), np.zeros(_REMEMBERED)
        # Sent altogether, sent since it last held nothing, newer than what is in force.
        self._n = self._since = self._behind = 0

    def sent(self, offset_um: Floats, now_s: float) -> int:
        """Remember a correction (3,) that goes out now, and return its number."""
        self.sequence = self.sequence % SEQUENCE_LIMIT + 1
        self._n += 1
        self._since += 1
        self._behind += 1
        self._sent_um[self._n % _REMEMBERED] = offset_um
        self._sent_s[self._n % _REMEMBERED] = now_s
        return self.sequence

    def report(self, echoed: int) -> bool:
        """Take the number that the machine's end has in force; tell whether it let go of ours.

        ``echoed``: 0 when nothing is in force.
        Raises ``DeviceError`` when it acts on a number that nobody here has sent: somebody else writes.
        """
        if echoed == 0:
            let_go, self.engaged = self.engaged, False
            if let_go:
                self._since = 0
            return let_go
        behind = (self.sequence - echoed) % SEQUENCE_LIMIT
        # One before the first: what the controller held when we came.
        if behind > (self.sequence - self._first + 1) % SEQUENCE_LIMIT:
            raise DeviceError(
                "another client writes the correction's registers; ours was released",
                code="serve.other_writer",
                got=f"the controller acts on number {echoed}",
                allowed=f"{self._first} to {self.sequence}",
                hint="end the other program or fieldbus that writes these registers",
            )
        if self.engaged and behind > self._behind:
            # Older than what was in force before: so is the state.
            return False
        self.engaged = behind < self._since
        if self.engaged:
            self._behind = behind
        return False

    def overdue_s(self, now_s: float) -> float:
        """Return for how long a correction has been sent and has not come into force."""
        if not self.engaged or self._behind == 0:
            return 0.0
        return now_s - float(self._sent_s[(self._n - min(self._behind, _REMEMBERED) + 1) % _REMEMBERED])

    @property
    def rests(self) -> bool:
        """Whether what is reported as in force is zero: then zero may be sent whatever is on its way."""
        if self._behind >= _REMEMBERED:
            return False
        return not self._sent_um[(self._n - self._behind) % _REMEMBERED].any()

    def since_s(self, now_s: float) -> float:
        """Return the time since the newest correction was sent; infinite before the first."""
        return now_s - float(self._sent_s[self._n % _REMEMBERED]) if self._n else math.inf

    def room_um(self, out_um: Floats, step_um: float) -> float:
        """Return how far the correction may go from ``out_um``, so that no change exceeds a step."""
        if not self.engaged:
            return step_um
        if self._behind >= _REMEMBERED:
            return 0.0
        return max(step_um - _farthest_kernel(self._sent_um, self._n, self._behind, out_um), 0.0)
