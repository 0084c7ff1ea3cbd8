"""The same work for many machines: in this process, in several, or on the workers of a Dask scheduler."""

from dtwin.fleet._engine import engine
from dtwin.fleet._jobs import DIAGNOSE, TRAIN, Job, Unit, recheck_job
from dtwin.fleet._run import FleetRun, run_fleet
from dtwin.fleet._view import fleet_view

__all__ = ["DIAGNOSE", "TRAIN", "FleetRun", "Job", "Unit", "engine", "fleet_view", "recheck_job", "run_fleet"]
