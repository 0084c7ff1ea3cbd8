"""Twins of campaigns of every kind: fit, compare, diagnose, learn, confirm, correct; versions on a shelf."""

__all__ = ["verbs"]
