"""Instruments, machines and files as sources of runs."""
