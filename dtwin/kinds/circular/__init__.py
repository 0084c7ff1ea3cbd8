"""Circular tests: the record of the kind."""
