"""The same work for many machines: in this process, in several, or on the workers of a Dask scheduler."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dtwin.offered import offered

if TYPE_CHECKING:
    from dtwin.fleet._alerts import Alert as Alert
    from dtwin.fleet._alerts import silence as silence
    from dtwin.fleet._alerts import tell as tell
    from dtwin.fleet._channels import channels_of as channels_of
    from dtwin.fleet._channels import try_channels as try_channels
    from dtwin.fleet._engine import engine as engine
    from dtwin.fleet._jobs import DIAGNOSE as DIAGNOSE
    from dtwin.fleet._jobs import TRAIN as TRAIN
    from dtwin.fleet._jobs import Job as Job
    from dtwin.fleet._jobs import Unit as Unit
    from dtwin.fleet._jobs import recheck_job as recheck_job
    from dtwin.fleet._nightly import Night as Night
    from dtwin.fleet._nightly import nightly as nightly
    from dtwin.fleet._run import FleetRun as FleetRun
    from dtwin.fleet._run import run_fleet as run_fleet
    from dtwin.fleet._sisters import SisterSize as SisterSize
    from dtwin.fleet._sisters import compared as compared
    from dtwin.fleet._sisters import sisters as sisters
    from dtwin.fleet._view import fleet_view as fleet_view

_PLACES = {
    "_alerts": "Alert silence tell",
    "_channels": "channels_of try_channels",
    "_engine": "engine",
    "_jobs": "DIAGNOSE Job TRAIN Unit recheck_job",
    "_nightly": "Night nightly",
    "_run": "FleetRun run_fleet",
    "_sisters": "SisterSize compared sisters",
    "_view": "fleet_view",
}
__all__ = " ".join(_PLACES.values()).split()
__getattr__ = offered(__name__, _PLACES)
