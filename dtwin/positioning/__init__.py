"""Positioning tests after ISO 230-2 of any axis: tables of targets, cycles and directions, their check and their figures.

It knows no kind of campaign: lengths and angles differ by a :class:`dtwin.positioning.ways.Scale`.
"""

__all__: list[str] = []
