"""Kinds of campaign: what differs between circular, linear, sinusoidal, volumetric and placement tests."""

__all__ = ["kind", "machine", "registry"]
