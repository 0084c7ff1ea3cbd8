"""When the scheduled training runs."""

from __future__ import annotations

from prefect.client.schemas.schedules import CronSchedule
from pydantic import ValidationError

from dtwin.errors import InputError

HOURLY = "0 * * * *"


def require_cron(cron: str) -> str:
    """Return a cron line that Prefect accepts.

    Args:
        cron: Five fields: minute, hour, day, month, weekday.

    Raises:
        InputError: When it is none.
    """
    try:
        return CronSchedule(cron=cron).cron
    except ValidationError as error:
        raise InputError(
            "not a cron line",
            code="schedule.cron",
            got=cron[:80],
            allowed="minute hour day month weekday",
            hint=f"every hour is '{HOURLY}', every night at two '0 2 * * *'",
        ) from error
