"""The built-in effects: one cause, one file."""
