"""Positioning tests along an axis: the record of the kind."""
