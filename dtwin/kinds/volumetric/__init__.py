"""Ball arrays: the record of the kind."""

__all__ = ["heat_twin", "motions", "twins"]
