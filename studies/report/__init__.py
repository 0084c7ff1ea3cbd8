"""What the studies found, as text."""
