"""What can act in a campaign, by the lake's rows; nothing here reads samples."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.lake.rows import meta_of
from dtwin.physics.effect import Effect
from dtwin.physics.library import campaign_instances
from dtwin.physics.state import AXES_OF
from dtwin.pipeline.catalogue import distinct


def possible_effects(rows: Sequence[Mapping[str, Any]], library: Mapping[str, Effect]) -> list[Effect]:
    """Return the effects that can act in a campaign, set-up terms left out, by name.

    ``rows``: its rows, at least one.
    """
    planes = distinct(rows, "plane")
    alone = {str(axis) for row in rows if (axis := meta_of(row).condition.get("axis"))}
    axes = sorted({axis for plane in planes for axis in AXES_OF[plane]} | alone)
    geometry = json.loads(rows[0]["geometry_json"])
    instances = campaign_instances(library, rows[0]["kind"], planes, axes, geometry)
    effects = {i.effect.name: i.effect for i in instances if not i.effect.setup}
    return [effects[name] for name in sorted(effects)]
