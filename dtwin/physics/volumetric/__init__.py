"""Errors of three axes in their whole volume, and how temperatures move them."""

__all__ = ["heat_diagnosis", "heat_twin", "motions"]
