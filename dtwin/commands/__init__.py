"""Bodies of the command line; heavy imports happen inside them."""

__all__: list[str] = []
