"""Dynamic part of a ball-bar campaign, by a published filter, its tuning and other ways.

Source: Xing, Bonev, Champliaud and Liu, Meas. Sci. Technol. 35 (2024) 085601, where that can be
evaluated; what it leaves open is stated where it is decided.
"""
