"""Ball arrays: the record of the kind, and its twins."""

__all__: list[str] = []
