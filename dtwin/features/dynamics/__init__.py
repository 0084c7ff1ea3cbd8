"""Dynamic part of a ball-bar recording: turns, filters, distances between curves, figures.

After Xing, Bonev, Champliaud and Liu, Meas. Sci. Technol. 35 (2024) 085601, where that can be
evaluated; what the paper leaves open is stated where it is decided.
"""
