"""Links to real controllers, each supervised in a process of its own."""

__all__ = ["axis_link", "linuxcnc", "state", "state_feed", "ur", "ur_registers", "virtual_key"]
