"""Figures of tests, effects and twins."""
