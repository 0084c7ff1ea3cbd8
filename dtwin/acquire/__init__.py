"""Instruments, machines and files as sources of runs."""

__all__ = ["b5r", "campaign_file", "campaign_folder", "runner"]
