"""The same work for many machines: in this process, in several, or on the workers of a Dask scheduler."""

from dtwin.fleet._alerts import Alert, silence, tell
from dtwin.fleet._channels import channels_of, try_channels
from dtwin.fleet._engine import engine
from dtwin.fleet._jobs import DIAGNOSE, TRAIN, Job, Unit, recheck_job
from dtwin.fleet._nightly import Night, nightly
from dtwin.fleet._run import FleetRun, run_fleet
from dtwin.fleet._sisters import SisterSize, compared, sisters
from dtwin.fleet._view import fleet_view

__all__ = [
    "DIAGNOSE",
    "TRAIN",
    "Alert",
    "FleetRun",
    "Job",
    "Night",
    "SisterSize",
    "Unit",
    "channels_of",
    "compared",
    "engine",
    "fleet_view",
    "nightly",
    "recheck_job",
    "run_fleet",
    "silence",
    "sisters",
    "tell",
    "try_channels",
]
