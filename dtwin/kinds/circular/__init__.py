"""Circles by ball bar: the record of the kind."""

__all__: list[str] = []
