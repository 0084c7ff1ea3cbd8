"""Errors of three axes in their whole volume, and how temperatures move them."""
