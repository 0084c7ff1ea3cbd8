"""The built-in effects: one cause, one file."""

__all__: list[str] = []
