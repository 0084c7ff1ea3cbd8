"""The life of a correction: trained, proved, promoted, checked again, exported."""

__all__: list[str] = []
