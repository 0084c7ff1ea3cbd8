"""Instruments, machines and files as sources of runs."""

__all__ = ["b5r", "campaign_folder", "runner"]
