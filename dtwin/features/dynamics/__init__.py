"""Dynamic part of a ball-bar recording: turns, filters, distances between curves, figures.

Source: Xing, Bonev, Champliaud and Liu, Meas. Sci. Technol. 35 (2024) 085601, where that can be
evaluated; what it leaves open is stated where it is decided.
"""

__all__ = ["distances", "figures", "filters", "turns"]
