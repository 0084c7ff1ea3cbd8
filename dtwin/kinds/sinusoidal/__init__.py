"""Tones: the record of the kind."""
