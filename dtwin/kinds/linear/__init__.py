"""Positioning along an axis: the record of the kind."""

__all__: list[str] = []
