"""The face of dtwin in a notebook: an open home, and what its verbs return."""

__all__ = ["answers", "open_home"]
