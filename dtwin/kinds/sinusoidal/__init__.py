"""Tones: the record of the kind."""

__all__: list[str] = []
