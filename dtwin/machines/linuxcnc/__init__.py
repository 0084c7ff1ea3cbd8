"""A real LinuxCNC in simulation: its machine is a component of its own HAL."""

__all__: list[str] = []
