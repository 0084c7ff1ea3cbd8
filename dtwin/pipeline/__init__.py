"""What drives machines: measuring, campaigns; as plain functions for commands and flows."""

__all__: list[str] = []
