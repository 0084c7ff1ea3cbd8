"""Candidates, validation, gates and the model registry."""

__all__: list[str] = []
