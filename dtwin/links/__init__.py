"""Links to real controllers, each supervised in a process of its own."""
