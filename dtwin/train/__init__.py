"""Candidates, validation, gates and the model registry."""
