"""Placements: the record of the kind."""
