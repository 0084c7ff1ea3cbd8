"""The steps of the main job, as plain functions: for commands, flows, tests and laptops."""

__all__ = ["twins"]
