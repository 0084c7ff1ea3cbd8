"""Plots, tables and self-contained HTML."""

__all__ = ["plots"]
