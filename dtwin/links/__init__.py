"""Links to real controllers, each supervised in a process of its own."""

__all__ = ["axis_link", "layout", "linuxcnc", "state_feed", "ur", "ur_registers", "virtual_key"]
