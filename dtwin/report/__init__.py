"""Plots, tables and self-contained HTML."""
