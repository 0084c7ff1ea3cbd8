"""An alarm for a correction that feeds on its own motion and grows."""

from __future__ import annotations

from dataclasses import dataclass

# Below this a growing error is noise.
_SMALLEST_UM = 0.05
_GROWTH = 1.05
_RISES = 3
_WORSE_THAN_NOTHING = 1.2
_THROWN, _MUCH, _NOTABLE = 2, 0.4, 0.2


@dataclass
class DivergenceWatch:
    """Watches the error that each window foretells of the motion as it is corrected.

    ``without_um``: what the equation foretold before anything was corrected; set by the first window.
    ``alarm``: why the correction must be released; empty while all is well.
    """

    without_um: float | None = None
    alarm: str = ""
    _last_um: float = 0.0
    _rises: int = 0
    _thrown: int = 0

    def window(self, left_um: float, *, inside: bool = True) -> str:
        """Take the error of a new window; return the alarm, empty while all is well.

        An alarm stays. It is raised when the error is well above what it was without correction, has
        grown three windows in a row to more than a fifth of that, or has twice thrown the motion out of the validity box while much of
        it was left: a correction that the box switches off and on again does not settle.

        ``left_um``: length of the error vector that the window foretells, um.
        ``inside``: whether the window lies in the validity box.
        """
        if not inside:
            return self._outside(left_um)
        if self.without_um is None:
            self.without_um = left_um
        elif not self.alarm:
            much = max(_NOTABLE * self.without_um, _SMALLEST_UM)
            grew = left_um > _GROWTH * self._last_um and left_um > much
            self._rises = self._rises + 1 if grew else 0
            if not left_um <= max(_WORSE_THAN_NOTHING * self.without_um, _SMALLEST_UM):
                self.alarm = (
                    f"the correction makes it worse: {left_um:z.2f} µm are foretold, "
                    f"{self.without_um:z.2f} µm were without"
                )
            elif self._rises >= _RISES:
                self.alarm = f"the error has grown {_RISES} windows in a row, to {left_um:z.2f} µm"
        self._last_um = left_um
        return self.alarm

    def _outside(self, left_um: float) -> str:
        if self.without_um is not None and left_um > max(_MUCH * self.without_um, _SMALLEST_UM):
            self._thrown += 1
            if self._thrown >= _THROWN and not self.alarm:
                self.alarm = (
                    f"the correction has thrown the motion out of the validity box {self._thrown} "
                    f"times, {left_um:z.2f} µm are left"
                )
        return self.alarm
