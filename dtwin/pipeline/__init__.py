"""What drives machines: measuring, campaigns, the cell, the demo; as plain functions for commands and flows."""

__all__: list[str] = []
