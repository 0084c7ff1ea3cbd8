"""Positioning of rotary axes: the record of the kind."""

__all__: list[str] = []
