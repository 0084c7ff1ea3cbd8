"""Bodies of the command line; heavy imports happen inside them."""
